"""Numbers, lists and counts as words of a report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from cqrun.figures.quantities import number, shown_unit

RAISED = str.maketrans({"^": None, "2": "²", "3": "³"})


def short(value: float) -> str:
    """Return a number with four digits."""
    return number(value)


def with_unit(value: float, unit: str, *, shown: bool = True) -> str:
    """Return a number with its SI unit, or with a prefix that suits its size if `shown`."""
    if shown:
        name, factor = shown_unit(unit or "1", value)
        return joined(short(factor * value), name)
    return joined(short(value), unit_text(unit))


def joined(value: str, unit: str) -> str:
    """Return a number and its unit, between which no line breaks."""
    space = "\N{NO-BREAK SPACE}"
    return f"{value}{space}{unit.replace(' ', space)}" if unit else value


def unit_text(unit: str) -> str:
    """Return a unit with raised digits; empty for pure numbers."""
    return "" if unit == "1" else unit.translate(RAISED)


def count(n: int, what: str) -> str:
    """Return a number of things: `1 run`, `2 runs`."""
    return f"{n:,} {what}{'' if n == 1 else 'es' if what.endswith('x') else 's'}"


def clipped(text: str, most: int = 200) -> str:
    """Return a text of at most `most` letters."""
    return text if len(text) <= most else f"{text[: most - 4].rstrip()} ..."


def some(names: Iterable[str], most: int = 8, between: str = ", ") -> str:
    """Return names with commas, or what else is `between` them, and how many are left out."""
    each = list(names)
    more = f" and {len(each) - most:,} more" if len(each) > most else ""
    return between.join(clipped(name, 240) for name in each[:most]) + more


def spread(values: Sequence[float]) -> str:
    """Return the range of numbers and their mean, or the number if all are equal."""
    low, high = min(values), max(values)
    return short(low) if low == high else f"{short(low)} to {short(high)}, mean {short(sum(values) / len(values))}"


def sentence(parts: Sequence[str]) -> str:
    """Return parts joined with commas and `and`."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}" if parts else ""

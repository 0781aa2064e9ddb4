"""Numbers and tables as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence


def number(value: float) -> str:
    """Return a number with five digits."""
    return f"{value:.5g}"


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """Yield the lines of a table whose columns are as wide as they need to be."""
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    for row in (head, *rows):
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()

"""The options of `cqrun material` as data: `strain=3`, `18mm2`, `FILE=planar`, `0:2`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.materials.curves import MODES, Mode
from cqrun.tensile.columns import ROLES
from cqrun.tensile.curve import EVERY
from cqrun.tensile.units import si_value

T = TypeVar("T")


def pairs(option: str, texts: Sequence[str], example: str) -> dict[str, str]:
    """Return the keys and values of texts such as `strain=3`.

    Raises:
        UsageError: a text is no pair.
    """
    found = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.strip() and value.strip()):
            raise UsageError(f"{option} {text}: must be KEY=VALUE, such as {option} {example}")
        found[key.strip()] = value.strip()
    return found


def roles(option: str, texts: Sequence[str], example: str) -> dict[str, str]:
    """Return pairs whose keys are roles of columns; raises as `pairs`, and for an unknown role."""
    found = pairs(option, texts, example)
    for role in found:
        if role not in ROLES:
            raise UsageError(f"{option} {role}=...: a column can be {listed(ROLES)}{suggest(role, ROLES)}")
    return found


def by_file(texts: Sequence[str], files: Sequence[Path], value_of: Callable[[str], T]) -> dict[str, T]:
    """Return the values of texts such as `18mm2` (for all files) and `FILE=18mm2`, by file."""
    names = {path.name for path in files}
    found: dict[str, T] = {}
    for text in texts:
        name, equals, value = text.rpartition("=")
        if equals and Path(name).name not in names:
            raise UsageError(f"'{text}': '{name}' is none of the files{suggest(name, names)}")
        found[Path(name).name if equals else EVERY] = value_of(value if equals else text)
    return found


def mode(text: str) -> Mode:
    """Return a mode; raise a UsageError if there is none of this name."""
    for name in MODES:
        if text == name:
            return name
    raise UsageError(f"--mode {text}: a test is {listed(MODES)}{suggest(text, MODES)}")


def area(text: str) -> float:
    """Return a cross-section [m^2]; raise a UsageError if it is none."""
    return si_value("area", text, "--area")


def gauge(text: str) -> float:
    """Return a length [m]; raise a UsageError if it is none."""
    return si_value("length", text, "--gauge")


def span(text: str | None) -> tuple[float, float] | None:
    """Return the smallest and the largest strain of `0:2`, `:1.5` or `10%:200%`.

    Raises:
        UsageError: it is no such text, or the first number is not the smaller one.
    """
    if text is None:
        return None
    match = re.fullmatch(r"\s*(-?[0-9.]+%?)?\s*:\s*(-?[0-9.]+%?)?\s*", text)
    ends = [float("-inf"), float("inf")]
    try:
        if match is None:
            raise ValueError
        for k, end in enumerate(match.groups()):
            if end is not None:
                ends[k] = float(end.rstrip("%")) * (0.01 if end.endswith("%") else 1.0)
        if not ends[0] < ends[1]:
            raise ValueError
    except ValueError:
        raise UsageError(
            f"--range {text}: must be two strains, the smaller one first, such as 0:2 or 0%:200%"
        ) from None
    return ends[0], ends[1]


def slack(text: str | None) -> float | None:
    """Return the strain at which the specimen is taut, of `0.02` or `2%`; None for `auto`.

    Raises:
        UsageError: it is none of these.
    """
    if text is None or text == "auto":
        return None
    try:
        return float(text.rstrip("%")) * (0.01 if text.endswith("%") else 1.0)
    except ValueError:
        raise UsageError(f"--slack {text}: must be a strain such as 0.02 or 2%, or auto; 0 if there is none") from None


def units(texts: Sequence[str]) -> Mapping[str, str]:
    """Return the units by role."""
    return roles("--unit", texts, "stress=MPa")

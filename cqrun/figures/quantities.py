"""Write key paths, units and numbers for pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cqrun.scene.keypath import split_own
from cqrun.units import Unit

MILLI = 1e3

_WORDS = {"youngs_modulus": "Young's modulus", "poissons_ratio": "Poisson's ratio", "density": "density"}
"""Names that are clear without the key before them."""

_ORDER = {"shear": "shear viscosity", "bulk": "bulk viscosity"}

_PREFIXES = {"Pa": (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3)), "m": (("m", 1.0), ("mm", 1e-3))}
"""Units that are shown with a prefix if the numbers are large or small enough, the largest first."""

_TIMES = (("h", 3600.0), ("min", 60.0), ("s", 1.0))
"""Units of time in seconds, the largest first."""

_RAISED = str.maketrans({"^": None, "2": "²", "3": "³"})

LARGE = 0.5
"""Lengths of at least this much are shown in metres [m]."""


def shown_unit(unit: str, largest: float) -> Unit:
    """Return the display unit for numbers with the SI unit `unit`, the largest of which is `largest`."""
    if unit == "m":
        return length_unit(largest)
    for name, size in _PREFIXES.get(unit, ()):
        if abs(largest) >= size:
            return Unit(name, 1.0 / size)
    return Unit("" if unit == "1" else unit.translate(_RAISED), 1.0)


def length_unit(extent: float) -> Unit:
    """Return metres or millimetres for lengths up to `extent` [m]."""
    return Unit("m", 1.0) if abs(extent) >= LARGE else Unit("mm", MILLI)


def time_unit(longest: float) -> Unit:
    """Return hours, minutes or seconds for times up to `longest` [s]."""
    return next(Unit(name, 1.0 / size) for name, size in _TIMES if longest >= 3 * size or size == 1.0)


def labels(paths: Sequence[str], dim: int) -> list[str]:
    """Return a short name for each key path; paths with the same short name get their differences as a prefix.

    An offset of a recording, and a value of one recording alone, have the name of the recording as a prefix.
    """
    owned, out = [_owner(path) for path in paths], []
    for owner, inside in owned:
        name = _label(inside, [other for of, other in owned if of == owner], dim)
        out.append(f"{owner}: {name}" if owner else name)
    return out


def _owner(path: str) -> tuple[str, str]:
    """Return the recording whose placement or own value a path is, and the path inside it; else an empty name."""
    keys = path.split(".")
    if keys[:2] == ["data", "recordings"] and keys[3:4] in (["offset"], ["rotation"]):
        return keys[2], ".".join(keys[3:])
    return split_own(path)


def _label(path: str, others: Sequence[str], dim: int) -> str:
    """Return a short name for a key path that is different from those of others."""
    name = capitalised(_short(path, dim))
    rivals = [other for other in others if other != path and capitalised(_short(other, dim)) == name]
    return _difference(path, rivals) + name if rivals else name


def capitalised(text: str) -> str:
    """Return text with a capital first letter and the others unchanged."""
    return text[:1].upper() + text[1:]


def _short(path: str, dim: int) -> str:
    *before, last = path.split(".")
    parent = before[-1] if before else ""
    if last.isdigit():
        axis = "xyz"[int(last)] if int(last) < 3 else last
        if parent in ("spin", "rotation") and dim == 2:
            axis = "z"  # the only axis of rotation in 2D
        prefix = " ".join(before[-2:]) if parent.isdigit() else parent  # `points 2`, of a polygon
        return f"{prefix} {axis}".replace("_", " ")
    if last in _WORDS:
        return _WORDS[last]
    if parent == "viscosity" and last in _ORDER:
        return _ORDER[last]
    return f"{parent} {last}".strip().replace("_", " ")


def _difference(path: str, rivals: Sequence[str]) -> str:
    """Return the keys of a path in which it differs from one of its rivals, followed by a colon."""
    keys = path.split(".")
    columns = [rival.split(".") for rival in rivals]
    different = [key for i, key in enumerate(keys) if any(len(c) <= i or c[i] != key for c in columns)]
    return f"{' '.join(different).replace('_', ' ')}: "


def error(value: float) -> str:
    """Return an error as text with three digits."""
    return f"{value:#.3g}".rstrip(".") if np.isfinite(value) else "not seen"


def number(value: float, width: float | None = None) -> str:
    """Return a number as text with four digits, or with the digits that are significant for an uncertainty `width`."""
    if width is None or not np.isfinite(width) or width <= 0:
        return f"{value:.4g}"
    decimals = 1 - int(np.floor(np.log10(width)))
    if decimals > 8 or abs(value) >= 1e7:
        return f"{value:.6g}"
    return f"{value:.{max(decimals, 0)}f}"


def estimate(value: float, interval: tuple[float, float] | None) -> str:
    """Return a value with its 95 % interval as text, such as `264.2 (263.6 to 264.7)`; all in display units."""
    if interval is None:
        return number(value)
    width = min(abs(interval[1] - value), abs(value - interval[0]))
    low, high = (number(end, width) for end in interval)
    return f"{number(value, width)} ({low} to {high})"

"""The units that testing machines write, as factors to SI."""

from __future__ import annotations

import re
from collections.abc import Mapping

from cqrun.errors import UsageError
from cqrun.explain import cut, listed

UNITS: Mapping[str, Mapping[str, float]] = {
    "stress": {
        "Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "N/mm2": 1e6, "N/cm2": 1e4, "N/m2": 1.0, "kN/m2": 1e3,
        "psi": 6894.757, "ksi": 6894757.0, "bar": 1e5, "kgf/cm2": 98066.5, "kgf/mm2": 9.80665e6,
    },
    "force": {"N": 1.0, "kN": 1e3, "mN": 1e-3, "gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216, "cN": 1e-2},
    "length": {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6, "in": 0.0254, "inch": 0.0254},
    "area": {"mm2": 1e-6, "cm2": 1e-4, "m2": 1.0, "in2": 0.0254**2},
    "strain": {
        "%": 1e-2, "1": 1.0, "-": 1.0, "mm/mm": 1.0, "m/m": 1.0, "in/in": 1.0, "percent": 1e-2,
    },
    "time": {"s": 1.0, "min": 60.0, "h": 3600.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "day": 86400.0},
}  # fmt: skip
"""Factor to SI by kind of quantity and unit."""

SPELLINGS: Mapping[str, str] = {
    **dict.fromkeys(("sec", "secs", "second", "seconds", "sek", "sekunde", "sekunden", "seconde", "secondes"), "s"),
    **dict.fromkeys(("mins", "minute", "minutes", "minuten"), "min"),
    **dict.fromkeys(("hr", "hrs", "hour", "hours", "std", "stunde", "stunden", "heure", "heures"), "h"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds", "millisekunden"), "ms"),
    **dict.fromkeys(("usec", "microsecond", "microseconds", "mikrosekunden"), "us"),
    **dict.fromkeys(("days", "tage", "jours"), "day"),
}
"""Units of time in words, in lower case."""


def tidy(unit: str) -> str:
    """Return a unit in one spelling: `N/mm²`, `N/mm^2` and ` N/mm2 ` are `N/mm2`."""
    for sign, plain in (("²", "2"), ("^", ""), ("µ", "u"), ("μ", "u"), (" ", ""), ("**", "")):
        unit = unit.replace(sign, plain)
    return unit.strip()


def factor(kind: str, unit: str) -> float | None:
    """Return what a unit of a kind of quantity is in SI, or None if the kind has no such unit.

    Machines write `MPA` and `Sec`, too: capitals count only where they would decide.
    """
    known, unit = UNITS[kind], tidy(unit)
    unit = SPELLINGS.get(unit.lower().rstrip("."), unit)
    if unit in known:
        return known[unit]
    similar = [value for name, value in known.items() if name.lower() == unit.lower()]
    return similar[0] if len(similar) == 1 else None


def kinds_of(unit: str) -> list[str]:
    """Return the kinds of quantity that have a unit."""
    return [kind for kind in UNITS if factor(kind, unit) is not None]


def si_value(kind: str, text: str, option: str) -> float:
    """Return the value [SI] of a text such as `18mm2` or `33 mm`.

    Raises:
        UsageError: it is not a positive number with a unit of this kind.
    """
    match = re.fullmatch(r"\s*([0-9]+(?:[.,][0-9]*)?(?:[eE][-+]?[0-9]+)?)\s*(\S+)\s*", text)
    times = factor(kind, match[2]) if match else None
    value = float(match[1].replace(",", ".")) if match else 0.0
    if times is None or value <= 0.0:
        raise UsageError(f"{option} must be a positive {kind} with its unit ({listed(UNITS[kind])}), is '{cut(text)}'")
    return value * times

"""Units beside SI: of lengths in recordings, of amounts of memory, and those in which numbers are shown."""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

LengthUnit = Literal["m", "cm", "mm"]
"""Length units that a recording may use."""

METRES: dict[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Each length unit in metres."""

_BYTES = {
    "B": 1,
    "kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12,
    "KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40,
}  # fmt: skip
_AMOUNT = re.compile(r"([0-9]{1,18}(?:\.[0-9]*)?|\.[0-9]+)\s*([A-Za-z]+)")


class Unit(NamedTuple):
    """A unit to show numbers in: `shown = factor * SI`; no name for numbers without a unit."""

    name: str
    factor: float

    def label(self, text: str) -> str:
        """Return text with the unit behind it, for an axis."""
        return f"{text} ({self.name})" if self.name else text


def force_units(dim: int) -> tuple[str, str]:
    """Return the units of a force and of a moment; those of a 2D world are per metre of depth."""
    return ("N", "N m") if dim == 3 else ("N/m", "N")


def parse_bytes(text: str) -> int:
    """Return the number of bytes in `2GiB`, `500 MB`, ...; raise a ValueError that says what is legal."""
    match = _AMOUNT.fullmatch(text.strip())
    if match is None or match[2] not in _BYTES:
        raise ValueError(f"must be an amount of memory such as 2GiB or 500MB, is '{text}'")
    return round(float(match[1]) * _BYTES[match[2]])


def format_bytes(count: float) -> str:
    """Return a number of bytes as text for a message: `1.5 GiB`."""
    for unit in ("TiB", "GiB", "MiB", "KiB"):
        if count >= _BYTES[unit]:
            return f"{count / _BYTES[unit]:.3g} {unit}"
    return f"{count:.0f} B"

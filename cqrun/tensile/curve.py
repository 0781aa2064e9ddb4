"""What a test measured, whatever its file had: stretch and nominal stress, and what is known of how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from cqrun.materials.curves import Mode
from cqrun.plugin.contract import Array

EVERY = ""
"""Key of a value that is given for all files."""


@dataclass(frozen=True)
class Given:
    """What the user has said; a file's name, or `EVERY`, is the key of what may differ from file to file.

    Attributes:
        columns: number (from 1) or name of a column by role.
        units: unit by role.
        mode: the test.
        area: at rest [m^2].
        gauge: length at rest [m].
        only: value that a row must have in a column of words.
        span: smallest and largest strain that count, or None.
        unloading: what to do with it.
        slack: strain at which the specimen is taut; None if the data decide.
        compression: whether strain and stress of a compression test are written without their signs; None if the file
            decides.
        relaxation: whether the strain is held; None if the data decide.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    mode: Mapping[str, Mode] = field(default_factory=dict)
    area: Mapping[str, float] = field(default_factory=dict)
    gauge: Mapping[str, float] = field(default_factory=dict)
    only: Mapping[str, str] = field(default_factory=dict)
    span: tuple[float, float] | None = None
    unloading: Literal["cut", "keep"] = "cut"
    slack: float | None = None
    compression: bool | None = None
    relaxation: bool | None = None

    def of_file(self, name: str, source: str) -> Any:
        """Return the value of `mode`, `area` or `gauge` for a file, or None."""
        values = getattr(self, name)
        return values.get(source, values.get(EVERY))


@dataclass(frozen=True)
class Curve:
    """One test: n points in the order of time.

    Attributes:
        source: the file's name.
        mode: the test.
        stretch: (n,) along the first axis; below 1 in compression.
        stress: (n,) nominal [Pa].
        line: (n,) of the file.
        time: (n,) [s], or None.
        strain_by: `crosshead`, `optical` or empty.
        specimen: what the file calls the material; may be empty.
        remarks: sentences on what was read how, and what was removed.
    """

    source: str
    mode: Mode
    stretch: Array
    stress: Array
    line: Array
    time: Array | None = None
    strain_by: str = ""
    specimen: str = ""
    remarks: tuple[str, ...] = ()

    @property
    def duration(self) -> float | None:
        """How long the test took [s], if the file says."""
        if self.time is None or not np.isfinite(self.time).all() or np.any(np.diff(self.time) <= 0.0):
            return None
        return float(np.ptp(self.time))

    @property
    def largest_stress(self) -> float:
        """The largest absolute value of its stress [Pa]."""
        return float(abs(self.stress).max())

    def at(self, rows: Any, *remarks: str) -> Curve:
        """Return the curve with some of its points, and further remarks."""
        time = None if self.time is None else self.time[rows]
        parts = {"stretch": self.stretch[rows], "stress": self.stress[rows], "line": self.line[rows], "time": time}
        return replace(self, **parts, remarks=(*self.remarks, *remarks))

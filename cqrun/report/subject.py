"""What the sections of a report are made from: a run, its pictures, and a film of its motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cqrun.errors import CqrunError
from cqrun.figures.run_data import RunData
from cqrun.measurements.measurement import Measurement
from cqrun.scene.paths import leaf

MISSING = "not recorded"


@dataclass(frozen=True)
class Film:
    """A film of a run in a file: its times [s] or points, its frames, and how fast it plays; `why` there is none."""

    path: Path | None = None
    first: float = 0.0
    last: float = 0.0
    frames: int = 0
    speed: float = 1.0
    why: str = ""


@dataclass(frozen=True)
class Subject:
    """A run that is reported.

    Attributes:
        run: its data.
        pictures: the pictures that its job draws, or none.
        why: why there are no pictures; empty if there are some, or if none are wanted.
        film: a film of its motion, or None.
    """

    run: RunData
    pictures: tuple[Path, ...] = ()
    why: str = ""
    film: Film | None = None

    def picture(self, stem: str) -> list[Path]:
        """Return the pictures whose names are `stem`, or begin with it if it ends in `_`."""
        return [p for p in self.pictures if p.stem == stem or (stem.endswith("_") and p.stem.startswith(stem))]

    def fact(self, *names: str) -> str:
        """Return an entry of run.json, or of a part of it, as text."""
        value: Any = self.run.record
        for name in names:
            value = value.get(name) if isinstance(value, dict) else None
        return MISSING if value in (None, "") else str(value)

    def measurement(self, recording: str) -> Measurement | None:
        """Return the measurement of a recording; None if the scene has no such recording."""
        data = self.run.scene.data
        known = data is not None and (data.recordings is None or recording in data.recordings)
        return data.measurement(recording) if data is not None and known else None

    def unit(self, path: str) -> str:
        """Return the SI unit of the number at a key path; empty if it has none, or if the scene has no such number."""
        try:
            unit = leaf(self.run.scene, path).unit
        except CqrunError:
            return ""
        return "" if unit == "1" else unit

"""Write observables.csv: one row per control step with the motion of each body; it can be read during the run.

time                          [s]
<body>.x, .y, .z              centre of mass [m]
<body>.kinetic_energy         sum of m |v|^2 / 2 [J; 2D: J/m]
<body>.least_volume_ratio     smallest det F of its particles
<body>.fastest                largest speed of a particle [m/s]
<body>.fracture               number of neighbours that no longer share a grid node (observers/fracture.py); in the
                              updated frame alone, because bodies of the reference frame cannot tear
"""

from __future__ import annotations

import csv
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.disk import open_file
from cqrun.engine.model import Inputs
from cqrun.observers.fracture import Fracture
from cqrun.state import State
from cqrun.store.atomic import disk_errors


def fracture_of(built: Built) -> Fracture:
    """Return the pairs of neighbouring particles of a scene, to detect fracture; none where a body cannot tear."""
    p = built.particles
    may_tear = {name: p.of(name) for name in p.names if built.model.frame == "updated"}
    return Fracture.of(p.x, may_tear, p.spacing, built.model.dx)


class Observables:
    """Writes a row per control step and keeps the extreme values; a context manager that closes the file.

    Attributes:
        fracture: the pairs of neighbours, and the largest number of lost pairs so far.
        fastest: largest speed so far by body [m/s].
        least_volume_ratio: smallest det F so far by body.
        last: by body, the last row: its values by column name.
    """

    def __init__(self, path: Path, built: Built, inputs: Inputs) -> None:
        """Open the file.

        Args:
            inputs: inputs of the rollout, for the masses of the particles.

        Raises:
            UsageError, RunError: the file cannot be written.
        """
        self.path = path
        self.fracture = fracture_of(built)
        self._bodies = {name: built.particles.of(name) for name in built.particles.names}
        self._mass = inputs.fields.mass
        self._step = built.scene.time.control_step
        self.fastest = dict.fromkeys(self._bodies, 0.0)
        self.least_volume_ratio = dict.fromkeys(self._bodies, np.inf)
        self.last: dict[str, dict[str, float]] = {}
        with disk_errors(path):
            self._file = open_file(path, "w", newline="", encoding="utf-8")
        self._table = csv.writer(self._file, lineterminator="\n")

    def record(self, control: int, state: State) -> None:
        """Write the row of a control step.

        Raises:
            UsageError, RunError: the row cannot be written.
        """
        lost = self.fracture.count(state.x)
        J = np.linalg.det(state.F)
        self.last = {body: self._row(body, state, J) for body in self._bodies}
        for body, number in lost.items():
            self.last[body]["fracture"] = number
        with disk_errors(self.path):
            if control == 0:
                self._table.writerow(["time", *(f"{b}.{name}" for b, row in self.last.items() for name in row)])
            time = control * self._step
            self._table.writerow([repr(time), *(repr(value) for row in self.last.values() for value in row.values())])
            self._file.flush()

    def _row(self, body: str, state: State, J: Any) -> dict[str, float]:
        part = self._bodies[body]
        m, v = self._mass[part], state.v[part]
        centroid = m @ state.x[part] / m.sum()
        squared = (v * v).sum(axis=1)
        fastest, least = float(np.sqrt(squared.max())), float(J[part].min())
        self.fastest[body] = max(self.fastest[body], fastest)
        self.least_volume_ratio[body] = min(self.least_volume_ratio[body], least)
        return {
            **dict(zip("xyz", centroid.tolist(), strict=False)),
            "kinetic_energy": 0.5 * float(m @ squared),
            "least_volume_ratio": least,
            "fastest": fastest,
        }

    def __enter__(self) -> Observables:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with disk_errors(self.path):
            self._file.close()

"""Reactions in a trajectory: force and moment of each boundary, for every control step.

/reactions/time (T) f8: the end of each control step [s]; a reaction is the mean over the step
/reactions/boundaries/NAME/force (T, D) f8, moment (T, 1) or (T, 3) f8; the attribute `unit` of each
/checksums/reactions/... (T) u4: CRC-32 of each row, as for the fields of particles
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.store.hdf5 import member, read_rows, write_rows
from cqrun.store.model_file import Part
from cqrun.units import force_units

if TYPE_CHECKING:
    import h5py

GROUP, TIME, BOUNDARIES, PARTS = "reactions", "time", "boundaries", ("force", "moment")


class BoundaryForce(Part):
    """The force with which a boundary acts on the bodies: its mean over the run, and its largest size [N; 2D: N/m]."""

    mean: list[float]
    largest: float


@dataclass(frozen=True)
class Reactions:
    """What boundaries do to the bodies, as means over control steps.

    Attributes:
        time: the end of each control step (T,) [s].
        force: of each boundary by name (T, D) [N]; 2D: [N/m].
        moment: (T, 1) or (T, 3) [N m]; 2D: [N].
    """

    time: Array
    force: dict[str, Array]
    moment: dict[str, Array]

    @classmethod
    def of(cls, held: dict[str, Array], dim: int, control_step: float) -> Reactions:
        """Return reactions from those of records (T + 1, D + 1) or (T + 1, 6), which have nothing in row 0."""
        steps = max((len(rows) for rows in held.values()), default=1)
        time = control_step * np.arange(1, steps)
        return cls(
            time, {name: rows[1:, :dim] for name, rows in held.items()},
            {name: rows[1:, dim:] for name, rows in held.items()},
        )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Size of all numbers [bytes], with checksums and names."""
        rows = [*self.force.values(), *self.moment.values()]
        return self.time.nbytes + sum(a.nbytes + 4 * len(a) + 4096 for a in rows)

    def write_to(self, file: h5py.File) -> None:
        """Write the reactions to a trajectory."""
        units = force_units(max((a.shape[1] for a in self.force.values()), default=3))
        arrays = {TIME: (self.time, "s")}
        for name in self.force:
            for part, of, unit in zip(PARTS, (self.force, self.moment), units, strict=True):
                arrays[f"{BOUNDARIES}/{name}/{part}"] = of[name], unit
        for name, (array, unit) in arrays.items():
            write_rows(file, f"{GROUP}/{name}", array, unit)


def read_reactions(file: h5py.File) -> Reactions | None:
    """Return the reactions in a trajectory; None if it has none.

    Raises:
        ValueError: they are not what was written.
    """
    if GROUP not in file:
        return None
    time, force, moment = read_rows(file, f"{GROUP}/{TIME}"), {}, {}
    for name in member(member(file, GROUP), BOUNDARIES):
        force[name], moment[name] = (
            read_rows(file, f"{GROUP}/{BOUNDARIES}/{name}/{part}", len(time)) for part in PARTS
        )
    return Reactions(time, force, moment)

"""The motion of rigid bodies in a trajectory, at every control step.

/rigid/time (T+1) f8: of every control step, from 0 on [s]
/rigid/bodies/NAME/displacement (T+1, D) f8, rotation (T+1, 1 or 3), velocity, spin; the attribute `unit` of each
/rigid/bodies/NAME: the attribute `center`, the centre at rest (D,) [m], from which displacements are
/checksums/rigid/... (T+1) u4: CRC-32 of each row, as for the fields of particles
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.store.hdf5 import member, read_rows, write_rows

if TYPE_CHECKING:
    import h5py

GROUP, TIME, BODIES, CENTER = "rigid", "time", "bodies", "center"
PARTS = {"displacement": "m", "rotation": "rad", "velocity": "m/s", "spin": "rad/s"}
"""What is written of a body, in this order, and its unit."""


@dataclass(frozen=True)
class RigidMotions:
    """How rigid bodies move.

    Attributes:
        time: of every control step (T + 1,) [s].
        rows: displacement, rotation, velocity and spin of each body (T + 1, 6 or 12), by name.
        center: the centre of each at rest (D,) [m], by name.
    """

    time: Array
    rows: dict[str, Array]
    center: dict[str, Array]

    @property
    def nbytes(self) -> int:
        """Size of all numbers [bytes], with checksums and names."""
        return self.time.nbytes + sum(a.nbytes + 16 * len(a) + 16384 for a in self.rows.values())

    def part(self, name: str, what: str) -> Array:
        """Return one of `PARTS` of a body (T + 1, ...)."""
        at = columns_of(len(self.center[name]))[what]
        return self.rows[name][:, at]

    def write_to(self, file: h5py.File) -> None:
        """Write the motion to a trajectory."""
        write_rows(file, f"{GROUP}/{TIME}", self.time, "s")
        for name in self.rows:
            for what, unit in PARTS.items():
                write_rows(file, f"{GROUP}/{BODIES}/{name}/{what}", self.part(name, what), unit)
            file[f"{GROUP}/{BODIES}/{name}"].attrs[CENTER] = self.center[name]


def columns_of(dim: int) -> dict[str, slice]:
    """Return the columns of each of `PARTS` in a world of `dim` dimensions."""
    turns = 2 * dim - 3
    ends = np.cumsum([0, dim, turns, dim, turns])
    return {what: slice(int(a), int(b)) for what, a, b in zip(PARTS, ends, ends[1:], strict=False)}


def read_rigid(file: h5py.File) -> RigidMotions | None:
    """Return the motion of rigid bodies in a trajectory; None if it has none.

    Raises:
        ValueError: it is not what was written.
    """
    if GROUP not in file:
        return None
    time, rows, center = read_rows(file, f"{GROUP}/{TIME}"), {}, {}
    for name in member(member(file, GROUP), BODIES):
        place = f"{GROUP}/{BODIES}/{name}"
        rows[name] = np.concatenate([read_rows(file, f"{place}/{what}", len(time)) for what in PARTS], axis=1)
        center[name] = np.asarray(file[place].attrs[CENTER], float)
    return RigidMotions(time, rows, center)

"""The recorded path of a marker, which a body should follow."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.observers.matter import Matter
from cqrun.plugin.contract import Array, Spec, quantity
from cqrun.plugin.reference import FileName
from cqrun.units import LengthUnit


class RecordedPath(Spec):
    """The path of a marker in a recording.

    With `relative` the body follows the marker's displacement, starting from its own centroid. This is for recordings
    with another origin than the scene. The recording must have the same axes as the scene. If the marker leaps
    to exact zeros, they are gaps. The path across a gap is straight.
    """

    file: FileName = Field(
        description="Recording of markers (C3D, CSV, TSV, TRC, a trajectory), from the scene's folder", min_length=1
    )
    marker: str = Field(description="Name of the marker in the file", min_length=1)
    start: float = quantity(
        "s", "Time in the file at which the run begins; the first frame of a C3D or Vicon file is at 0", default=0.0
    )
    units: LengthUnit | None = Field(description="Length unit of the file, if it does not name one", default=None)
    relative: bool = Field(description="Whether to follow the displacement, not the position", default=False)

    def course(self, matter: Matter, begins: Array) -> Array:
        """Return where a centroid that starts at `begins` (D,) should be at the end of every control step (T, D) [m].

        Between frames, and while the marker was not seen, the path is interpolated linearly.

        Raises:
            UsageError: the file cannot be read or has no such marker, it has another dimension than the world, the
                marker was not seen from the start to the end of the run, or it leaves the world.
        """
        time, positions = matter.recorded(self.file, self.units, self.marker)
        source, dim = f"{self.file}: marker '{self.marker}'", matter.dim
        if positions.shape[1] != dim:
            raise UsageError(f"{source} was recorded in {positions.shape[1]}D, the world has {dim} dimensions")
        at = self.start + matter.control_step * np.arange(matter.n_controls + 1)
        slack = 1e-9 * at[-1]
        if len(time) == 0 or time[0] > at[0] + slack or time[-1] < at[-1] - slack:
            when = f"from {time[0]:g} to {time[-1]:g} s" if len(time) else "never"
            raise UsageError(f"{source} was seen {when}; the run needs it from {at[0]:g} to {at[-1]:g} s")
        path = np.stack([np.interp(at, time, column) for column in positions.T], axis=1)
        if self.relative:
            path = path - path[0] + begins
        outside = np.argwhere((path < 0) | (path > matter.size))
        if len(outside):
            step, axis = outside[0]
            raise UsageError(
                f"{source} leaves the world after {step * matter.control_step:g} s: {'xyz'[axis]} = "
                f"{path[step, axis]:g} m, outside 0 to {matter.size[axis]:g} m; `relative: true` follows the "
                "displacement, not the position"
            )
        return path[1:]

"""Choose the frames of a recording that are compared with a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.errors import DataError
from cqrun.plugin.contract import Array

LEAST_FRAMES = 2
"""Smallest number of compared frames. One frame shows no motion, and often means that times are not in seconds."""


@dataclass(frozen=True)
class Window:
    """The part of a recording that a run covers.

    Attributes:
        control_step: time between two records of the model [s].
        steps: number of control steps that the model runs.
        start: time in the recording when the run begins [s].
        start_bounds: bounds of `start` if it is an unknown [s]; None if it is fixed.
        skip: time after the start that is not compared [s].
        source: name of the recording in error messages.
    """

    control_step: float
    steps: int
    start: float
    start_bounds: tuple[float, float] | None = None
    skip: float = 0.0
    source: str = "recording"

    @property
    def length(self) -> float:
        """Length of the run [s]."""
        return self.steps * self.control_step

    @property
    def bounds(self) -> tuple[float, float]:
        """The earliest and the latest start [s]."""
        return self.start_bounds or (self.start, self.start)

    def frames(self, time: Array) -> Array:
        """Return the indices of the compared frames; they are the same for every start inside the bounds.

        They do not depend on the start, so that the loss has no jumps: they go from the earliest start to the last
        frame that a run from every start reaches. The skipped time counts from the latest start, so that no compared
        frame is inside it, whatever the start.

        Raises:
            DataError: the window is not inside the recording, or holds fewer than LEAST_FRAMES.
        """
        source, start, bounds, length, skip = self.source, self.start, self.bounds, self.length, self.skip
        first, last = float(time[0]), float(time[-1])
        slack = 1e-6 * (last - first) / (len(time) - 1)
        if start < first - slack or start + length > last + slack:
            raise DataError(
                f"{source}: the window, {start:g} to {start + length:g} s (start + length), does not lie inside "
                f"the recording, {first:g} to {last:g} s"
            )
        if bounds[1] - bounds[0] > length - skip:
            raise DataError(
                f"{source}: the start may be anywhere from {bounds[0]:g} to {bounds[1]:g} s, but only "
                f"{length - skip:g} s after it are compared: narrow the bounds, or compare for longer"
            )
        begin, end = bounds[1] + skip if skip > 0 else bounds[0], bounds[0] + length
        frames = np.flatnonzero((time >= begin - slack) & (time <= end + slack))
        if frames.size < LEAST_FRAMES:
            how_many = "only one frame lies" if frames.size else "no frame lies"
            raise DataError(
                f"{source}: {how_many} between {begin:g} and {end:g} s, which are compared; {LEAST_FRAMES} or more "
                f"must: times are in seconds, and the recording's run from {first:g} to {last:g}"
            )
        return frames

    def require_still(self, still: tuple[float, float]) -> None:
        """Refuse still frames that overlap the time in which the model moves [s].

        Raises:
            DataError: they overlap, so that their mean is not a rest position.
        """
        begin, end = self.bounds[0], self.bounds[1] + self.steps * self.control_step
        slack = 1e-9 * max(abs(begin), abs(end))
        if still[1] > begin + slack and still[0] < end - slack:
            raise DataError(
                f"{self.source}: the still frames, {still[0]:g} to {still[1]:g} s, overlap with {begin:g} to "
                f"{end:g} s, when the body may already move: end `still` at {begin:g} s at the latest, the earliest "
                "possible `start`"
            )

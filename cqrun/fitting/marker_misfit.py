"""How far a model's markers are from recorded ones.

Error of a marker in a frame: model displacement since the release, less the recorded displacement
from the marker's own mean over the still frames (or positions, where the recording is in the scene's
frame already). Loss: the mean over seen markers and frames of the squared length of the error [m^2].
RMSE: its root, so that loss = RMSE^2, whatever the number of coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.engine.model import Records
from cqrun.errors import DataError
from cqrun.fitting.points import Points
from cqrun.objectives.hermite import SLACK, interpolant
from cqrun.plugin.contract import Array

LEAST_FRAMES = 2
"""That are compared: one alone tells nothing of a motion, and is what is left where times are not in seconds."""


@dataclass(frozen=True)
class Misfit:
    """Root mean squares of the errors' lengths [m].

    Attributes:
        total: over all seen markers and frames.
        markers: by marker; NaN for one that is not seen in the window.
    """

    total: float
    markers: dict[str, float]


class MarkerObjective:
    """The errors of one recording.

    The frames that count are fixed once, from the bounds of `start`, so that the loss has no jumps in
    it: those from the earliest release that is allowed, to the last that every release reaches. In
    frames before the release the model rests. Where time after it is skipped, they begin so long after
    the latest release that is allowed: wherever the start ends up, none of them is in what is skipped.

    Attributes:
        times: (F,) the recording's times of the frames that count [s].
        data: (F, M, D) recorded displacements or positions [m]; 0 where not seen.
        seen: (F, M) of bool.
        names: M markers.
        count: number of seen markers and frames together.
        still: (T_s, M, D) displacements in the still frames [m]; T_s = 0 where there are none.
        weight: of this recording among others.
    """

    def __init__(
        self,
        observer: Points,
        names: Sequence[str],
        time: Array,
        values: Array,
        *,
        control_step: float,
        steps: int,
        start: float,
        start_bounds: tuple[float, float] | None = None,
        skip: float = 0.0,
        still: Array | None = None,
        absolute: bool = False,
        weight: float = 1.0,
        source: str = "recording",
    ) -> None:
        """Choose the frames.

        Args:
            observer: of the M markers.
            time: (T,) of the recording [s].
            values: (T, M, D) displacements [m], or positions if `absolute`; NaN where not seen.
            control_step: of the model's record [s].
            steps: control steps that the model runs; their time is the window's length.
            start: time of the release in the recording [s].
            start_bounds: where `start` may go if it is an unknown [s].
            skip: time after the release that does not count [s].
            still: (T_s, M, D) still frames' displacements, whose mean `values` are from [m]; NaN where not seen.
            source: how errors name the recording.

        Raises:
            DataError: the window is not inside the recording, has fewer than LEAST_FRAMES, or no marker is seen in it.
        """
        self.observer, self.names, self.absolute, self.weight = observer, tuple(names), absolute, weight
        self.control_step, self.steps = control_step, steps
        self.start_bounds = start_bounds or (start, start)
        frames = _frames(time, start, self.start_bounds, steps * control_step, skip, source)
        self.times = np.asarray(time, dtype=float)[frames]
        self.seen = ~np.isnan(values[frames]).any(axis=2)
        self.data = np.where(self.seen[..., None], values[frames], 0.0)
        self.still = np.zeros((0, *self.data.shape[1:])) if still is None else still
        self.count = int(self.seen.sum())
        if self.count == 0:
            raise DataError(
                f"{source}: no marker is seen between {self.times[0]:g} and {self.times[-1]:g} s; "
                "choose another start or length"
            )

    def reaches(self, start: float) -> bool:
        """Say whether the model's run, begun at `start` [s], lasts until the last frame that counts."""
        return start >= self.earliest - SLACK * self.control_step

    @property
    def earliest(self) -> float:
        """The earliest start from which the model's run lasts until the last frame that counts [s]."""
        return float(self.times[-1]) - self.steps * self.control_step

    def tracks(self, record: Records, start: float) -> Array:
        """Return the model's displacements or positions at `times`, (F, M, D) [m]."""
        y, w = self.observer.observe(record)
        model = interpolant(self.times - start, self.control_step, self.steps)(y, w)
        return model if self.absolute else model - y[0]

    def residuals(self, record: Records, start: float) -> Array:
        """Return the errors of the seen markers, frame by frame, (count * D,) [m]."""
        return np.asarray((self.tracks(record, start) - self.data)[self.seen].ravel())

    def residuals_vjp(self, record: Records, start: float, r_bar: Array) -> tuple[Records, float]:
        """Return the cotangents of the record and of `start` from that of the residuals."""
        y, w = self.observer.observe(record)
        at = interpolant(self.times - start, self.control_step, self.steps)
        out_bar = np.zeros_like(self.data)
        out_bar[self.seen] = r_bar.reshape(self.count, -1)
        y_bar, w_bar = at.vjp(out_bar)
        if not self.absolute:
            y_bar[0] -= out_bar.sum(axis=0)
        return self.observer.observe_vjp(record, y_bar, w_bar), -float(np.sum(out_bar * at.slope(y, w)))

    def loss(self, record: Records, start: float) -> float:
        """Return the mean squared length of the errors [m^2]."""
        return float(np.sum(self.residuals(record, start) ** 2) / self.count)

    def loss_vjp(self, record: Records, start: float, loss_bar: float = 1.0) -> tuple[Records, float]:
        """Return the cotangents of the record and of `start` from that of the loss."""
        return self.residuals_vjp(record, start, (2.0 * loss_bar / self.count) * self.residuals(record, start))

    def misfit(self, record: Records, start: float) -> Misfit:
        """Return the root mean square errors, in all and by marker."""
        squared = ((self.tracks(record, start) - self.data) ** 2).sum(axis=2) * self.seen
        frames = self.seen.sum(axis=0)
        by_marker = [float(np.sqrt(s / n)) if n else float("nan") for s, n in zip(squared.sum(0), frames, strict=True)]
        return Misfit(float(np.sqrt(squared.sum() / self.count)), dict(zip(self.names, by_marker, strict=True)))

    def series(self) -> list[tuple[Array, Array, Array]]:
        """Return each marker's coordinates: their places among the residuals, their frames, their still values.

        Places and frames are in order of time.
        """
        dim = self.data.shape[2]
        place = np.full(self.seen.shape, -1)
        place[self.seen] = np.arange(self.count)
        tracks = [(m, column[column >= 0], np.flatnonzero(column >= 0)) for m, column in enumerate(place.T)]
        return [
            (dim * track + axis, frames, self.still[:, m, axis])
            for m, track, frames in tracks
            if track.size
            for axis in range(dim)
        ]


def _frames(time: Array, start: float, bounds: tuple[float, float], length: float, skip: float, source: str) -> Array:
    """Return the indices of the frames that count, whatever start inside `bounds` is tried."""
    first, last = float(time[0]), float(time[-1])
    slack = 1e-6 * (last - first) / (len(time) - 1)
    if start < first - slack or start + length > last + slack:
        raise DataError(
            f"{source}: the window, {start:g} to {start + length:g} s (start + length), does not lie inside "
            f"the recording, {first:g} to {last:g} s"
        )
    if bounds[1] - bounds[0] > length - skip:
        raise DataError(
            f"{source}: the start may be anywhere from {bounds[0]:g} to {bounds[1]:g} s, but only {length - skip:g} s "
            "after it are compared: narrow the bounds, or compare for longer"
        )
    begin, end = bounds[1] + skip if skip > 0 else bounds[0], bounds[0] + length
    frames = np.flatnonzero((time >= begin - slack) & (time <= end + slack))
    if frames.size < LEAST_FRAMES:
        how_many = "only one frame lies" if frames.size else "no frame lies"
        raise DataError(
            f"{source}: {how_many} between {begin:g} and {end:g} s, which are compared; {LEAST_FRAMES} or more must: "
            f"times are in seconds, and the recording's run from {first:g} to {last:g}"
        )
    return frames

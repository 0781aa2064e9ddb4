"""Compare measured time series with those of a model.

The error of a channel in a frame is the model's value, or its change from the rest shape, minus the measured value. A
run begins in the rest shape, unless it begins at equilibrium. The loss is the mean squared length of the errors, over
all frames and channels that were seen. The RMSE is the root of the loss, so loss = RMSE^2 for any number of components.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cqrun.engine.model import Records
from cqrun.errors import DataError
from cqrun.measurements.comparison import Comparison, Misfit
from cqrun.measurements.measurement import Measurement, Recorded
from cqrun.measurements.placement import Placement
from cqrun.objectives.hermite import SLACK, Interpolant, interpolant, linear
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class SeriesComparison(Comparison):
    """Compare a recording of M channels, with D components each, with a model.

    A subclass defines the model's channels by `observe` and `observe_vjp`. The compared frames are chosen once
    (`Window.frames`). In frames before the run begins, the model is at rest.

    Attributes:
        times: (F,) times of the compared frames in the recording [s].
        data: (F, M, D) measured values; 0 where not seen.
        seen: (F, M) of bool.
        names: M channels.
        count: number of pairs of a channel and a frame in which it was seen.
        still: (T_s, M, D) values in the still frames; T_s = 0 if there are none.
    """

    def __init__(
        self,
        spec: Measurement,
        recorded: Recorded,
        rows: csr_array,
        names: Sequence[str],
        time: Array,
        values: Array,
        *,
        still: Array | None = None,
        relative: bool = False,
        remark: str = "",
        doubts: tuple[str, ...] = (),
    ) -> None:
        """Choose the frames.

        Args:
            spec: the measurement.
            recorded: the recording as the scene describes it.
            rows: (K, N) weights of the sums over particles that `observe` needs.
            names: M channels.
            time: (T,) of the recording [s].
            values: (T, M, D) measured values; NaN where not seen.
            still: (T_s, M, D) values in the still frames, minus the same mean as `values`; NaN where not seen.
            relative: whether `values` are compared with the model's change from the rest shape.
            remark: what a user should know about how the recording was made.
            doubts: what looks wrong in it, and what is done about it.

        Raises:
            DataError: the window is not inside the recording, has too few frames, or no channel is seen in it.
        """
        self.spec, self.rows, self.names = spec, rows, tuple(names)
        self.window, self.weight, self.relative = recorded.window, recorded.weight, relative
        self.remark, self.doubts = remark, doubts
        frames = self.window.frames(time)
        self.times = np.asarray(time, dtype=float)[frames]
        self.seen = ~np.isnan(values[frames]).any(axis=2)
        self.data = np.where(self.seen[..., None], values[frames], 0.0)
        self.still = np.zeros((0, *self.data.shape[1:])) if still is None else still
        self.origin: Array | None = None  # the channels of the rest shape (M, D), if the run does not begin there
        self.count = int(self.seen.sum())
        if self.count == 0:
            raise DataError(
                f"{self.window.source}: no {spec.channel} is seen between {self.times[0]:g} and {self.times[-1]:g} s; "
                "choose another start or length"
            )
        if recorded.still is not None:
            self.window.require_still(recorded.still)

    # --- what a subclass says ---------------------------------------------------------------------------------

    @abstractmethod
    def observe(self, records: Records) -> tuple[Array, Array | None]:
        """Return the channels at control steps, and their derivatives by time, both (T+1, M, D).

        Frames between two control steps are interpolated: by a cubic, or linearly if the derivatives are None.
        """

    @abstractmethod
    def observe_vjp(self, records: Records, y_bar: Array, w_bar: Array) -> Records:
        """Return the cotangent of the records from those of what `observe` returns, both (T+1, M, D)."""

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the D components, for the table and pictures."""
        size = self.data.shape[2]
        return (self.spec.quantity,) if size == 1 else tuple("xyz"[:size])

    # --- errors -----------------------------------------------------------------------------------------------

    @property
    def earliest(self) -> float:
        """The earliest start from which the model's run reaches the last compared frame [s]."""
        return float(self.times[-1]) - self.window.length

    @property
    def size(self) -> int:
        """Number of residuals."""
        return self.count * self.data.shape[2]

    def too_early(self, start: float) -> str:
        """Return why a start is too early, so that the run ends before the last compared frame; empty if it is not."""
        if start >= self.earliest - SLACK * self.window.control_step:
            return ""
        return (
            f"must be {self.earliest:.6g} s or later, is {start:.6g} s: frames are compared up to "
            f"{self.times[-1]:.6g} s, and the run would end before; load the scene with that start, or with it as an "
            "unknown whose bounds hold that value"
        )

    def _observed(self, records: Records, start: float) -> tuple[Array, Array, Interpolant]:
        """Return the channels and their derivatives at control steps, and their interpolant at the frames."""
        y, w = self.observe(records)
        between = linear if w is None else interpolant
        at = between(self.times - start, self.window.control_step, self.window.steps)
        return y, np.zeros_like(y) if w is None else w, at

    def model(self, records: Records, start: float) -> Array:
        """Return the model's values at `times` (F, M, D), as they are compared with the data."""
        y, w, at = self._observed(records, start)
        model = at(y, w)
        return model - (y[0] if self.origin is None else self.origin) if self.relative else model

    def residuals(self, records: Records, start: float) -> Array:
        """Return the errors of the seen channels, frame by frame, (count * D,)."""
        return np.asarray((self.model(records, start) - self.data)[self.seen].ravel())

    def residuals_vjp(self, records: Records, start: float, r_bar: Array) -> tuple[Records, float]:
        """Return the cotangents of the records and of `start` from that of the residuals."""
        y, w, at = self._observed(records, start)
        out_bar = np.zeros_like(self.data)
        out_bar[self.seen] = r_bar.reshape(self.count, -1)
        y_bar, w_bar = at.vjp(out_bar)
        if self.relative and self.origin is None:
            y_bar[0] -= out_bar.sum(axis=0)
        return self.observe_vjp(records, y_bar, w_bar), -float(np.sum(out_bar * at.slope(y, w)))

    def loss(self, records: Records, start: float) -> float:
        """Return the mean squared length of the errors."""
        return float(np.sum(self.residuals(records, start) ** 2) / self.count)

    def loss_vjp(self, records: Records, start: float, loss_bar: float = 1.0) -> tuple[Records, float]:
        """Return the cotangents of the records and of `start` from that of the loss."""
        return self.residuals_vjp(records, start, (2.0 * loss_bar / self.count) * self.residuals(records, start))

    def from_rest(self, records: Records) -> SeriesComparison:
        """Return the comparison with changes counted from the rest shape, whose records are given."""
        other = copy.copy(self)
        other.origin = self.observe(records)[0][0]
        return other

    def placed(self, placement: Placement) -> SeriesComparison:
        """Return the comparison with measured values that are turned and moved."""
        other = copy.copy(self)
        other.data = np.where(self.seen[..., None], placement.of(self.data), 0.0)
        if placement.rotation.any():
            other.still = self.still @ placement.matrix.T
        return other

    def measured_vjp(self, records: Records, start: float, loss_bar: float = 1.0) -> tuple[Array, Array]:
        """Return the measured values (count, D) and their cotangents, from that of the loss."""
        errors = self.residuals(records, start).reshape(self.count, -1)
        return self.data[self.seen], (-2.0 * loss_bar / self.count) * errors

    def misfit(self, records: Records, start: float) -> Misfit:
        """Return the root mean square errors, in all and by channel."""
        squared = ((self.model(records, start) - self.data) ** 2).sum(axis=2) * self.seen
        frames = self.seen.sum(axis=0)
        each = [float(np.sqrt(s / n)) if n else float("nan") for s, n in zip(squared.sum(0), frames, strict=True)]
        return Misfit(float(np.sqrt(squared.sum() / self.count)), dict(zip(self.names, each, strict=True)))

    # --- reports --------------------------------------------------------------------------------------------------

    def summary(self) -> str:
        """Describe the comparison for `cqrun validate`."""
        channels = f"{len(self.names)} {self.spec.channel}" + ("" if len(self.names) == 1 else "s")
        return (
            f"{channels}, {len(self.times)} frames from {self.times[0]:.5g} to {self.times[-1]:.5g} s, "
            f"release at {self.window.start:.5g} s, {self.seen.mean():.1%} seen"
        )

    def series(self) -> list[tuple[Array, Array, Array]]:
        """Return for each component of a channel its places among the residuals, its frames and its still values.

        Places and frames are in order of time.
        """
        size = self.data.shape[2]
        place = np.full(self.seen.shape, -1)
        place[self.seen] = np.arange(self.count)
        tracks = [(m, column[column >= 0], np.flatnonzero(column >= 0)) for m, column in enumerate(place.T)]
        return [
            (size * track + axis, frames, self.still[:, m, axis])
            for m, track, frames in tracks
            if track.size
            for axis in range(size)
        ]

    def table(self, records: Records, start: float) -> Iterator[list[object]]:
        """Yield the rows of the table: channel, time since the run began, data, model; first the columns' names."""
        names = self.components
        yield [self.spec.channel, "time", *(f"data_{name}" for name in names), *(f"model_{name}" for name in names)]
        model = self.model(records, start)
        for m, channel in enumerate(self.names):
            for f, time in enumerate(self.times):
                data = self.data[f, m] if self.seen[f, m] else np.full(len(names), np.nan)
                yield [channel, float(time - start), *data.tolist(), *model[f, m].tolist()]

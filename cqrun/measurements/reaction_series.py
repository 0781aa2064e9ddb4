"""A boundary's force or moment over time, beside the model's.

The model has means over control steps. A mean belongs to the middle of its step, so that nothing is late by half a
step; the values at control steps, between which the comparison interpolates linearly, follow from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.engine.model import Records
from cqrun.errors import DataError
from cqrun.measurements.measurement import Measurement, Recorded
from cqrun.measurements.series import SeriesComparison
from cqrun.plugin.contract import Array

TELLS = 0.2
"""A model's force that is a smaller part of the measured one says nothing about its sign."""


def may_be_opposite(column: str, spec: Measurement, sign: float, data: float, model: float, which: str) -> str:
    """Return the question whether a measured force has the other sign."""
    here, other = ("body", "boundary") if sign > 0 else ("boundary", "body")
    unit = spec.shown.name
    return (
        f"is '{column}' the {spec.quantity} on the {other}? It is {data:.4g} {unit}, and the model, with {which}, has "
        f"{model:.4g} {unit} on the {here}; if so, say `on: {other}`"
    )


class ReactionSeries(SeriesComparison):
    """One component of a boundary's force or moment in motion; further arguments as `SeriesComparison`, and:

    Args:
        index: place of the component among D forces and the moments that follow them.
        values: (T,) measured; NaN where nothing was.
    """

    def __init__(self, spec: Any, recorded: Recorded, n_particles: int, index: int, time: Array, values: Array) -> None:
        rows = sparse.csr_array((0, n_particles))
        super().__init__(spec, recorded, rows, [spec.boundary], time, values[:, None, None])
        self.boundary, self.index, self.from_first = spec.boundary, index, spec.from_first
        self.column, self.sign = spec.column, 1.0 if spec.on == "body" else -1.0
        if self.from_first:
            if not self.seen[0, 0]:
                raise DataError(
                    f"{recorded.file}: `from_first` needs a value in the first line that is compared, at "
                    f"{self.times[0]:g} s"
                )
            self.data = np.where(self.seen[..., None], self.data - self.data[0], 0.0)

    def observe(self, records: Records) -> tuple[Array, None]:
        """Return the component at control steps (T + 1, 1, 1)."""
        mean = records.held[self.boundary][1:, self.index]
        return (self.sign * at_control_steps(mean))[:, None, None], None

    def observe_vjp(self, records: Records, y_bar: Array, w_bar: Array) -> Records:
        """Return the cotangent of the records from that of the component."""
        bar = records.zeros_like()
        bar.held[self.boundary][1:, self.index] = at_control_steps_vjp(self.sign * y_bar[:, 0, 0])
        return bar

    def model(self, records: Records, start: float) -> Array:
        """Return the model's values at `times` (F, 1, 1), as they are compared with the data."""
        model = super().model(records, start)
        return model - model[0] if self.from_first else model

    def residuals_vjp(self, records: Records, start: float, r_bar: Array) -> tuple[Records, float]:
        """Return the cotangents of the records and of `start` from that of the residuals."""
        if self.from_first:  # the first line is seen, and its value goes into all errors
            first = np.zeros(len(r_bar))
            first[0] = r_bar.sum()
            r_bar = r_bar - first
        return super().residuals_vjp(records, start, r_bar)

    def findings(self, records: Records, start: float) -> Iterator[str]:
        """Yield a question if the model's largest value has another sign than the measured one."""
        model, seen = self.model(records, start)[:, 0, 0], self.seen[:, 0]
        k = int(np.argmax(np.abs(self.data[:, 0, 0]) * seen))
        data, there = float(self.data[k, 0, 0]), float(model[k])
        if there * data < 0 and abs(there) > TELLS * abs(data):
            yield may_be_opposite(self.column, self.spec, self.sign, data, there, "the values of this run")


def at_control_steps(mean: Array) -> Array:
    """Return values at control steps 0 .. T from means over them (T,): linear between the middles, and beyond them."""
    if len(mean) == 1:
        return np.repeat(mean, 2)
    ends = 1.5 * mean[0] - 0.5 * mean[1], 1.5 * mean[-1] - 0.5 * mean[-2]
    return np.concatenate([ends[:1], 0.5 * (mean[1:] + mean[:-1]), ends[1:]])


def at_control_steps_vjp(value_bar: Array) -> Array:
    """Return the cotangent of the means (T,) from that of the values (T + 1,)."""
    if len(value_bar) == 2:
        return value_bar.sum(keepdims=True)
    mean_bar = np.zeros(len(value_bar) - 1)
    mean_bar[1:] += 0.5 * value_bar[1:-1]
    mean_bar[:-1] += 0.5 * value_bar[1:-1]
    mean_bar[:2] += value_bar[0] * np.array([1.5, -0.5])
    mean_bar[-2:] += value_bar[-1] * np.array([-0.5, 1.5])
    return mean_bar

"""Base of measurements at rest: what a body does under stated loads, one equilibrium after another.

The file is a table with a column for each load; `loads` says which number of the scene each column is. The model finds
the equilibrium of every line, from that of the line before or from the rest shape, whichever is nearer to it
(`engine/statics/path.py`).

Row 0 of the records is the rest shape without loads, row k the k-th point. The error of a channel at a point is the
model's value minus the measured one, and the loss the mean squared length of the errors.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from cqrun.engine.model import Records
from cqrun.errors import DataError
from cqrun.measurements.comparison import Comparison, Misfit
from cqrun.measurements.load_table import LoadTable
from cqrun.measurements.measurement import Measurement, Recorded
from cqrun.measurements.placement import Placement
from cqrun.plugin.contract import Array, Spec

if TYPE_CHECKING:
    from scipy.sparse import csr_array

LABEL = "pose"
"""Column with the name of each point; optional in a table with one line per point."""

NOT_SI = ("mm", "cm", "kPa", "MPa", "bar", "mbar", "mN", "kN", "g", "kg_f", "deg", "percent")
"""Units at the end of a load's name that no number of a scene has."""


class Load(Spec):
    """What a column of loads drives."""

    path: str = Field(description="Key path of the number that it is, or activation.NAME", min_length=1)
    factor: float = Field(description="What the column is multiplied by, such as 1000 from kPa to Pa", default=1.0)


class RestMeasurement(Measurement):
    """A measurement of bodies at rest under loads that a table gives."""

    at_rest: ClassVar[bool] = True

    loads: dict[str, str | Load] = Field(
        description="Column -> key path of the scene's number that it is, in the unit of this number, such as "
        "actuators.left.cable.tension, loads.pull.point_force.force.2 or activation.left; or {path, factor}",
        default_factory=dict,
    )
    ignore: list[str] = Field(description="Columns that mean nothing to the model", default_factory=list)

    @property
    def drives(self) -> dict[str, Load]:
        """What every column of loads drives."""
        return {name: Load(path=load) if isinstance(load, str) else load for name, load in self.loads.items()}

    def line_loads(self, table: LoadTable) -> list[dict[str, float]]:
        """Return the loads of every line by key path.

        Raises:
            DataError: a column of `loads` or `ignore` is not in the table, two columns drive the same, or a cell is no
                number.
        """
        for column in (*self.loads, *self.ignore):
            table.require(column, "the load" if column in self.loads else "of `ignore`,")
        lines: list[dict[str, float]] = [{} for _ in table.rows]
        for column, load in self.drives.items():
            if load.path in lines[0]:
                raise DataError(f"{table.source}: two columns of `loads` drive '{load.path}': name it once")
            for line, value in zip(lines, (load.factor * table.numbers(column)).tolist(), strict=True):
                line[load.path] = value
        return lines

    def require_loads(self, table: LoadTable, points: int) -> None:
        """Raise a DataError if nothing distinguishes several points."""
        if points > 1 and not self.loads:
            raise DataError(
                f"{table.source}: has {points} {LABEL}s, but `loads` names no column, so that the model is the same in "
                "all of them: name the columns of the loads, and what each drives, such as "
                "`loads: {tension_N: actuators.left.cable.tension}`"
            )

    def questions(self) -> Iterator[str]:
        """Yield what is probably wrong with the units of the loads."""
        for column, load in self.drives.items():
            unit = next((unit for unit in NOT_SI if column.endswith((f"_{unit}", f"[{unit}]", f"({unit})"))), None)
            if unit is not None and load.factor == 1.0:
                yield (
                    f"is the load '{column}' in {unit}? {load.path} is in the SI unit: give "
                    f"{{path: {load.path}, factor: ...}}"
                )


class RestComparison(Comparison):
    """Compare M channels, with D components each, with a model at P points.

    A subclass defines the model's channels by `observe` and `observe_vjp`.

    Attributes:
        points: the loads of each point, by key path.
        loads: the column that drives each key path.
        along: names of the points (P,), or numbers; for the table and pictures.
        axis: what `along` is.
        data: (P, M, D) measured values; 0 where not measured.
        seen: (P, M, D) of bool.
        names: M channels.
        count: number of pairs of a point and a channel that was measured.
    """

    def __init__(
        self, spec: RestMeasurement, recorded: Recorded, rows: csr_array, names: Sequence[str],
        points: Sequence[Mapping[str, float]], along: tuple[str, Sequence[str | float]], values: Array,
    ) -> None:  # fmt: skip
        """Keep what was measured.

        Args:
            spec: the measurement.
            recorded: the recording as the scene describes it.
            rows: (K, N) weights of the sums over particles that `observe` needs.
            names: M channels.
            points: the loads of each point, by key path.
            along: what the points are called by, and the name or number of each.
            values: (P, M, D) measured values; NaN where nothing was measured.

        Raises:
            DataError: nothing was measured.
        """
        self.spec, self.rows, self.names, self.weight = spec, rows, tuple(names), recorded.weight
        self.points = tuple(dict(point) for point in points)
        self.loads = {load.path: column for column, load in spec.drives.items()}
        self.axis, self.along = along
        self.seen = ~np.isnan(values)
        self.data = np.where(self.seen, values, 0.0)
        self.count = int(self.seen.any(axis=2).sum())
        self.doubts = tuple(spec.questions())
        if self.count == 0:
            raise DataError(f"{recorded.file}: no {spec.channel} was measured at any point")

    # --- what a subclass says -----------------------------------------------------------------------------------------

    @abstractmethod
    def observe(self, records: Records) -> Array:
        """Return the model's channels at the rest shape and at every point (P + 1, M, D)."""

    @abstractmethod
    def observe_vjp(self, records: Records, y_bar: Array) -> Records:
        """Return the cotangent of the records from that of `observe`."""

    @property
    def telling(self) -> tuple[int, ...]:
        """The points by which a wrong sign shows; none by default."""
        return ()

    def questions_at(self, records: Records) -> list[str]:
        """Return what is probably wrong, for the model's records at the `telling` points."""
        return []

    def wrong_at_the_end(self, records: Records) -> list[str]:
        """Return what is wrong beyond doubt, for the model's records at all points with the values of the result."""
        return []

    @property
    def point_names(self) -> tuple[str, ...]:
        """What each point is called in messages, such as pose 'up'."""
        return tuple(
            f"{self.axis} '{name}'" if isinstance(name, str) else f"{self.axis} {name:g}" for name in self.along
        )

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the D components, for the table and pictures."""
        size = self.data.shape[2]
        return (self.spec.quantity,) if size == 1 else tuple("xyz"[:size])

    # --- errors -------------------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """Number of residuals."""
        return int(self.seen.sum())

    def errors(self, records: Records) -> Array:
        """Return the model's values minus the measured ones (P, M, D); 0 where nothing was measured."""
        return np.where(self.seen, self.observe(records)[1:] - self.data, 0.0)

    def residuals(self, records: Records, start: float) -> Array:
        """Return the errors of what was measured, point by point."""
        return self.errors(records)[self.seen]

    def loss(self, records: Records, start: float) -> float:
        """Return the mean squared length of the errors."""
        return float(np.sum(self.errors(records) ** 2) / self.count)

    def loss_vjp(self, records: Records, start: float, loss_bar: float = 1.0) -> tuple[Records, float]:
        """Return the cotangent of the records from that of the loss, and 0 as that of `start`."""
        errors = self.errors(records)
        y_bar = np.concatenate([np.zeros((1, *errors.shape[1:])), (2.0 * loss_bar / self.count) * errors])
        return self.observe_vjp(records, y_bar), 0.0

    def require_all_axes(self, file: Path) -> None:
        """Raise a DataError if an axis was not measured: such positions cannot be turned."""
        if (self.seen.any(axis=2) != self.seen.all(axis=2)).any():
            raise DataError(
                f"{file}: `rotation` turns positions, which needs all axes of each {self.spec.channel}, and the file "
                "leaves some out: remove `rotation`"
            )

    def placed(self, placement: Placement) -> RestComparison:
        """Return the comparison with measured positions that are turned and moved."""
        other = copy.copy(self)
        other.data = np.where(self.seen, placement.of(self.data), 0.0)
        return other

    def measured_vjp(self, records: Records, start: float, loss_bar: float = 1.0) -> tuple[Array, Array]:
        """Return the measured positions (n, D) [m] and their cotangents, from that of the loss."""
        there = self.seen.any(axis=2)
        return self.data[there], (-2.0 * loss_bar / self.count) * self.errors(records)[there]

    def misfit(self, records: Records, start: float) -> Misfit:
        """Return the root mean square errors, in all and by channel."""
        squared, pairs = (self.errors(records) ** 2).sum(axis=2), self.seen.any(axis=2).sum(axis=0)
        each = [float(np.sqrt(s / n)) if n else float("nan") for s, n in zip(squared.sum(axis=0), pairs, strict=True)]
        return Misfit(float(np.sqrt(squared.sum() / self.count)), dict(zip(self.names, each, strict=True)))

    # --- reports ------------------------------------------------------------------------------------------------------

    def summary(self) -> str:
        """Describe the comparison for `cqrun validate`."""
        channels = f"{len(self.names)} {self.spec.channel}" + ("" if len(self.names) == 1 else "s")
        ranges = []
        for path, column in self.loads.items():
            values = [point[path] for point in self.points]
            ranges.append(f"{column} is {path}, {min(values):.4g} to {max(values):.4g}")
        points = f"{len(self.points)} equilibri{'um' if len(self.points) == 1 else 'a'}"
        return f"{channels} in {points}; {'; '.join(ranges) or 'no loads but those of the scene'}"

    def series(self) -> list[tuple[Array, Array, Array]]:
        """Return for each component of a channel its places among the residuals, and its points; no still values."""
        place = np.full(self.seen.shape, -1)
        place[self.seen] = np.arange(self.size)
        columns = (place[:, m, axis] for m in range(place.shape[1]) for axis in range(place.shape[2]))
        return [(c[c >= 0], np.flatnonzero(c >= 0), np.zeros(0)) for c in columns if (c >= 0).any()]

    def table(self, records: Records, start: float) -> Iterator[list[object]]:
        """Yield the rows of the table: channel, point, data, model; first the columns' names."""
        names = self.components
        yield [self.spec.channel, self.axis, *(f"data_{name}" for name in names), *(f"model_{name}" for name in names)]
        model = self.observe(records)[1:]
        data = np.where(self.seen, self.data, np.nan)
        for m, channel in enumerate(self.names):
            for p, point in enumerate(self.along):
                yield [channel, point, *data[p, m].tolist(), *model[p, m].tolist()]

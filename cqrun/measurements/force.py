"""Force and moment: how a boundary holds a body, at rest against the loads on it, or in motion over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy import sparse

from cqrun.engine.model import Records
from cqrun.engine.statics.path import RestRecords
from cqrun.errors import DataError
from cqrun.explain import Loc, complaint, finding, listed
from cqrun.measurements.at_rest import LABEL, RestComparison, RestMeasurement
from cqrun.measurements.load_table import LoadTable, factor_of, read_table
from cqrun.measurements.measurement import Recorded
from cqrun.measurements.reaction_series import TELLS, ReactionSeries, may_be_opposite
from cqrun.objectives.reaction import place_of, wrong_axis
from cqrun.observers.matter import Matter
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BoundaryName
from cqrun.plugin.registry import plugin
from cqrun.units import Unit

NEWTONS: Mapping[str, float] = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
NEWTON_METRES: Mapping[str, float] = {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "kNm": 1e3}
"""Units that the name of a measured column may end in. A 2D world has N/m and N."""


SECONDS: Mapping[str, float] = {"s": 1.0, "ms": 1e-3}
"""Units that the name of a column of times may end in."""


class Reaction(RestMeasurement):
    """One component of what a boundary does to the bodies that it holds."""

    channel: ClassVar[str] = "boundary"
    takes: ClassVar[frozenset[str]] = frozenset()
    units: ClassVar[Mapping[str, float]]

    boundary: BoundaryName = Field(description="Boundary that is measured")
    time: str | None = Field(
        description="Column with the times [s] of a motion; its name may end in a unit, such as time_ms. Without it, "
        "each line is an equilibrium under its loads",
        default=None,
        exclude_if=lambda time: time is None,
    )
    column: str = Field(description="Column with what was measured; its name may end in a unit, such as force_mN")
    on: Literal["body", "boundary"] = Field(
        description="On what the measured force acts: on the body, or on the boundary, as a load cell behind it shows",
        default="body",
    )
    from_first: bool = Field(
        description="Compare changes from the first line, as of a load cell that was set to zero there; in motion from "
        "the first line that is compared",
        default=False,
    )

    @model_validator(mode="after")
    def _in_motion_or_at_rest(self) -> Self:
        if self.time is not None and self.loads:
            message = "belong to equilibria, and `time` to a motion, whose loads are those of the scene: remove one"
            raise complaint(type(self).__name__, [finding(message, ("loads",), involves=("time",))])
        return self

    @property
    def compares_rest(self) -> bool:
        """Whether it compares equilibria, and not a motion."""
        return self.time is None

    @property
    def boundaries(self) -> tuple[str, ...]:
        """The boundary whose reactions in motion it needs."""
        return () if self.compares_rest else (self.boundary,)

    @property
    def table_name(self) -> str:
        """Name of the file with data and model."""
        return self.table_file() if self.compares_rest else f"{self.name}_in_motion.csv"

    def index(self, dim: int) -> int:
        """Return the place of the component among D forces and the moments that follow them."""
        raise NotImplementedError

    def bind(self, recorded: Recorded, matter: Matter) -> ReactionComparison | ReactionSeries:
        table = read_table(recorded.file)
        table.require(self.column, "the force")
        si = next(iter(self.units))
        values = factor_of(self.column, self.units, None, si, table.source) * table.numbers(self.column, missing=True)
        if self.time is not None:
            return self._over_time(table, self.time, values, recorded, matter)
        points = self.line_loads(table)
        table.require_all_used(
            {self.column, *self.loads, *self.ignore, LABEL}, "is neither a load nor the force",
            otherwise="if it is the time of a motion, name it in `time`; ",
        )  # fmt: skip
        self.require_loads(table, len(points))
        if self.from_first and (len(values) < 2 or np.isnan(values[0])):
            raise DataError(f"{table.source}: `from_first` needs a force in the first line, and a second line")
        return ReactionComparison(self, recorded, matter, points, _along(self, table), values)

    def _over_time(
        self, table: LoadTable, column: str, values: Array, recorded: Recorded, matter: Matter
    ) -> ReactionSeries:
        """Return the comparison with a motion."""
        table.require(column, "the time")
        for other in self.ignore:
            table.require(other, "of `ignore`,")
        if unused := [name for name in table.head if name not in {self.column, column, *self.ignore}]:
            raise DataError(
                f"{table.source}: the column{'s' * (len(unused) > 1)} {listed(unused)} is neither the time nor the "
                "force: add it to `ignore`; the loads of a motion are those of the scene"
            )
        time = factor_of(column, SECONDS, None, "s", table.source) * table.numbers(column)
        if len(back := np.flatnonzero(np.diff(time) <= 0)):
            k = int(back[0])
            raise DataError(
                f"{table.source}:{table.lines[k + 1]}: {column} does not increase: {time[k]:.9g} s is followed by "
                f"{time[k + 1]:.9g} s"
            )
        if len(time) < 2:
            raise DataError(f"{table.source}: has one line; a recording of a motion needs 2 or more")
        return ReactionSeries(self, recorded, matter.n_particles, self.index(matter.dim), time, values)


def _along(spec: Reaction, table: LoadTable) -> tuple[str, list[str | float]]:
    """Return the column against which the force is shown, and its values: the first load that changes."""
    for column in spec.loads:
        numbers = table.numbers(column)
        if np.ptp(numbers) > 0:
            return column, numbers.tolist()
    labels = table.texts(LABEL) if LABEL in table.head else [str(k + 1) for k in range(len(table.rows))]
    return LABEL, list(labels)


@plugin("measurement", "force")
class Force(Reaction):
    """A component of the force with which a boundary acts on the bodies: at rest under loads, or in motion over time.

    The file is CSV with the measured force. At rest, each line is an equilibrium, with a column for each load. In
    motion, `time` names the column with the times; the model's force is the mean over each control step, at the middle
    of the step, linear between the middles, and continued before the first and after the last. The force of a boundary
    is the sum over the nodes that it holds, or over the points that touch it. Of a node that several boundaries hold, a
    `slip` takes the force along its normal, and a `sticky` the rest; of two `sticky` ones the first takes all. The
    scene needs `world.frame: reference`.
    """

    quantity: ClassVar[str] = "force"
    unit: ClassVar[str] = "N"
    shown: ClassVar[Unit] = Unit("N", 1.0)
    units: ClassVar[Mapping[str, float]] = NEWTONS

    component: Literal["x", "y", "z"] = Field(description="Axis along which the force is measured")

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return super().dim_problems(dim) + wrong_axis(self.component, "force", dim)

    def index(self, dim: int) -> int:
        """Return the place of the component among D forces and the moments that follow them."""
        return place_of(self.component, "force", dim)


@plugin("measurement", "moment")
class Moment(Reaction):
    """A component of the moment with which a boundary acts on the bodies.

    It is about the centre of the material inside a `sticky` or `slip` boundary at rest, or the clamp's `center`. For a
    boundary that bodies touch it is about the origin of the world. The file is as for `force`. In 2D the only component
    is z.
    """

    quantity: ClassVar[str] = "moment"
    unit: ClassVar[str] = "N m"
    shown: ClassVar[Unit] = Unit("Nm", 1.0)
    units: ClassVar[Mapping[str, float]] = NEWTON_METRES

    component: Literal["x", "y", "z"] = Field(
        description="Axis about which the moment is measured; z in 2D", default="z"
    )

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return super().dim_problems(dim) + wrong_axis(self.component, "moment", dim)

    def index(self, dim: int) -> int:
        """Return the place of the component among D forces and the moments that follow them."""
        return place_of(self.component, "moment", dim)


class ReactionComparison(RestComparison):
    """One component of a boundary's force or moment, beside the model's; arguments as `RestComparison`, and:

    Args:
        matter: the particles of the scene.
        values: (P,) measured; NaN where nothing was.
    """

    def __init__(
        self, spec: Reaction, recorded: Recorded, matter: Matter, points: Any, along: Any, values: Array
    ) -> None:
        rows = sparse.csr_array((0, matter.n_particles))
        self.boundary, self.index, self.from_first = spec.boundary, spec.index(matter.dim), spec.from_first
        self.column = spec.column
        self.sign = 1.0 if spec.on == "body" else -1.0
        if self.from_first:
            values = np.append(np.nan, values[1:] - values[0])
        super().__init__(spec, recorded, rows, [spec.boundary], points, along, values[:, None, None])

    @property
    def telling(self) -> tuple[int, ...]:
        """The first point, and the one with the largest measured value."""
        return (0, max(1, int(np.argmax(np.abs(self.data[:, 0, 0]))))) if len(self.points) > 1 else (0,)

    def observe(self, records: Records) -> Array:
        """Return the component at the rest shape and at every point (P + 1, 1, 1)."""
        assert isinstance(records, RestRecords)
        y = self.sign * records.held[self.boundary][:, self.index]
        return np.asarray((y - y[1] if self.from_first else y)[:, None, None])

    def observe_vjp(self, records: Records, y_bar: Array) -> Records:
        """Return the cotangent of the records from that of the component."""
        assert isinstance(records, RestRecords)
        bar, held_bar = records.zeros_like(), self.sign * y_bar[:, 0, 0]
        if self.from_first:
            held_bar[1] -= held_bar.sum()
        bar.held[self.boundary][:, self.index] = held_bar
        return bar

    def questions_at(self, records: Records) -> list[str]:
        """Return a question if the model's value at the last `telling` point has another sign than the measured one."""
        model, data = float(self.observe(records)[-1, 0, 0]), float(self.data[self.telling[-1], 0, 0])
        if not (model * data < 0 and abs(model) > TELLS * abs(data)):
            return []
        return [may_be_opposite(self.column, self.spec, self.sign, data, model, "the values that the fit starts from")]

    def wrong_at_the_end(self, records: Records) -> list[str]:
        """Return a sentence if the model's value at the last `telling` point still has the wrong sign."""
        if not self.telling:
            return []
        k = self.telling[-1]
        model, data = float(self.observe(records)[k + 1, 0, 0]), float(self.data[k, 0, 0])
        if not (model * data < 0 and abs(model) > TELLS * abs(data)):
            return []
        unit = self.spec.shown.name
        return [
            f"'{self.column}' has the wrong sign with the values found, too: it is {data:.4g} {unit}, and the model "
            f"has {model:.4g} {unit}; so these values mean nothing: turn the sign in the file, or set `on` to the "
            "other side"
        ]

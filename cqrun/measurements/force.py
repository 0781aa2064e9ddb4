"""Force and moment: how a boundary holds a body at rest, against the loads on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy import sparse

from cqrun.engine.model import Records
from cqrun.engine.statics.path import RestRecords
from cqrun.errors import DataError
from cqrun.explain import Loc
from cqrun.measurements.at_rest import LABEL, RestComparison, RestMeasurement
from cqrun.measurements.load_table import LoadTable, factor_of, read_table
from cqrun.measurements.measurement import Recorded
from cqrun.observers.matter import Matter
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BoundaryName
from cqrun.plugin.registry import plugin
from cqrun.units import Unit

NEWTONS: Mapping[str, float] = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
NEWTON_METRES: Mapping[str, float] = {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "kNm": 1e3}
"""Units that the name of a measured column may end in. A 2D world has N/m and N."""

TELLS = 0.2
"""A model's force that is a smaller part of the measured one says nothing about its sign."""


class Reaction(RestMeasurement):
    """One component of what a boundary does to the bodies that it holds."""

    channel: ClassVar[str] = "boundary"
    units: ClassVar[Mapping[str, float]]

    boundary: BoundaryName = Field(description="Boundary that is measured")
    column: str = Field(description="Column with what was measured; its name may end in a unit, such as force_mN")
    on: Literal["body", "boundary"] = Field(
        description="On what the measured force acts: on the body, or on the boundary, as a load cell behind it shows",
        default="body",
    )
    from_first: bool = Field(
        description="Compare changes from the first line, as of a load cell that was set to zero there", default=False
    )

    def index(self, dim: int) -> int:
        """Return the place of the component among D forces and the moments that follow them."""
        raise NotImplementedError

    def bind(self, recorded: Recorded, matter: Matter) -> ReactionComparison:
        table = read_table(recorded.file)
        table.require(self.column, "the force")
        si = next(iter(self.units))
        values = factor_of(self.column, self.units, None, si, table.source) * table.numbers(self.column, missing=True)
        points = self.line_loads(table)
        table.require_all_used({self.column, *self.loads, *self.ignore, LABEL}, "is neither a load nor the force")
        self.require_loads(table, len(points))
        if self.from_first and (len(values) < 2 or np.isnan(values[0])):
            raise DataError(f"{table.source}: `from_first` needs a force in the first line, and a second line")
        return ReactionComparison(self, recorded, matter, points, _along(self, table), values)


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
    """A component of the force with which a boundary holds the bodies, at rest under the loads of each line.

    The file is CSV: one line for each equilibrium, with the measured force and a column for each load. The force of a
    boundary is the sum over the nodes that it holds; a node that several boundaries hold counts for the first. The
    scene needs `world.frame: reference`.
    """

    quantity: ClassVar[str] = "force"
    unit: ClassVar[str] = "N"
    shown: ClassVar[Unit] = Unit("N", 1.0)
    units: ClassVar[Mapping[str, float]] = NEWTONS

    component: Literal["x", "y", "z"] = Field(description="Axis along which the force is measured")

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        wrong = [(("component",), "a 2D world has no axis z")] if self.component == "z" and dim == 2 else []
        return super().dim_problems(dim) + wrong

    def index(self, dim: int) -> int:
        """Return the place of the component among D forces and the moments that follow them."""
        return "xyz".index(self.component)


@plugin("measurement", "moment")
class Moment(Reaction):
    """A component of the moment with which a boundary holds the bodies, about the centre of what it holds at rest.

    The file is as for `force`. In 2D the only component is z.
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
        message = "a moment in a 2D world is about z"
        wrong: list[tuple[Loc, str]] = [(("component",), message)] if self.component != "z" and dim == 2 else []
        return super().dim_problems(dim) + wrong

    def index(self, dim: int) -> int:
        """Return the place of the component among D forces and the moments that follow them."""
        return 2 if dim == 2 else 3 + "xyz".index(self.component)


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
        here, other = ("body", "boundary") if self.sign > 0 else ("boundary", "body")
        unit = self.spec.shown.name
        return [
            f"is '{self.column}' the {self.spec.quantity} on the {other}? It is {data:.4g} {unit}, and the model, with "
            f"the values that the fit starts from, has {model:.4g} {unit} on the {here}; if so, say `on: {other}`"
        ]

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

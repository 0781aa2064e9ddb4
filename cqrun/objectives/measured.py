"""A measured quantity as a term, or its squared difference from a target."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.measures.measure import BoundMeasure
from cqrun.objectives.gaps import lengths, lengths_vjp
from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import Matter
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import MeasureName
from cqrun.plugin.registry import plugin


@plugin("objective", "measured")
class Measured(ObjectiveTerm):
    """A quantity of the section `measure`, in its own unit: one component, or the size of all of them.

    With a `target` it is the squared difference from it: (component - target)^2, or the sum over all components.
    Without one it should be small; with a negative weight it should be large.
    """

    quantity: MeasureName = Field(description="Name of the measured quantity")
    component: str | None = Field(
        description="Component, such as x; the root of the sum of the squares of all if absent", default=None
    )
    target: float | list[float] | None = Field(
        description="What it should be, in its own unit: a number, or one for each component", default=None
    )

    @property
    def least(self) -> float:  # type: ignore[override]
        """The lowest value."""
        return 0.0 if self.target is not None else -np.inf

    def bind(self, matter: Matter) -> BoundTerm:
        measure: BoundMeasure = matter.measured(self.quantity)
        columns = chosen_components(measure, self.component)
        target = None if self.target is None else np.atleast_1d(np.array(self.target, float))
        count = columns.stop - columns.start
        if target is not None and len(target) != count:
            parts = listed(measure.components)
            more = f": give {count} ({parts}), or a `component`" if count > 1 else ": it is a single number"
            raise UsageError(f"the target has {len(target)} numbers, and the quantity '{self.quantity}' {count}{more}")
        return MeasuredTerm(self, measure, columns, target)


def chosen_components(measure: BoundMeasure, component: str | None) -> slice:
    """Return the columns of a component of a measured quantity, or of all.

    Raises:
        UsageError: it has no such component.
    """
    if component is None:
        return slice(0, len(measure.components))
    if component not in measure.components or component == "":
        names = [name for name in measure.components if name]
        have = f"; there are: {listed(names)}" if names else ": it is a single number, leave `component` out"
        raise UsageError(f"there is no component '{component}'{suggest(component, names)}{have}")
    k = measure.components.index(component)
    return slice(k, k + 1)


class MeasuredTerm(BoundTerm):
    """A number of a measured quantity, its size, or its squared gap."""

    def __init__(self, spec: Measured, measure: BoundMeasure, columns: slice, target: Array | None) -> None:
        self.measure, self.columns, self.target = measure, columns, target
        self.rows, self.over = measure.rows, spec.over
        self.single = columns.stop - columns.start == 1

    def steps(self, track: Track) -> Array:
        found = self.measure.values(track)[1:, self.columns]
        if self.target is not None:
            return lengths(found - self.target, squared=True)
        return np.asarray(found[:, 0]) if self.single else lengths(found, squared=False)

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        values: Any = self.measure.values(track)
        found, bar = values[1:, self.columns], np.zeros(values.shape)
        if self.target is not None:
            bar[1:, self.columns] = lengths_vjp(found - self.target, True, h_bar)
        elif self.single:
            bar[1:, self.columns] = h_bar[:, None]
        else:
            bar[1:, self.columns] = lengths_vjp(found, False, h_bar)
        return self.measure.values_vjp(track, bar)

"""A measured quantity as a controller sees it."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.observers.matter import Matter
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import Range, limits
from cqrun.observers.track import Track
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import MeasureName
from cqrun.plugin.registry import plugin


@plugin("observer", "measured")
class Measured(Observer):
    """A quantity of the section `measure`, such as a bend angle: all its components.

    The quantity must depend on the motion at one moment alone. A tension, a work and a reaction do not: they depend on
    the activation, or on what is known only after a control step. Stresses and energies are not seen either.
    """

    quantity: MeasureName = Field(description="Name of the measured quantity")
    range: Range = Field(
        description="[low, high] in the quantity's unit that is scaled to [-1, 1], or one pair for each component; "
        "auto: its usual range; null: values as they are",
        default="auto",
    )

    def bind(self, matter: Matter) -> BoundObserver:
        measure = matter.measured(self.quantity)
        if not measure.instant:
            raise UsageError(
                f"a controller cannot see '{self.quantity}' ({measure.meaning}): it does not depend on the motion at "
                "one moment alone; positions, displacements, velocities, rotations, distances, bend angles, strains, "
                "stretches and lengths of cables do"
            )
        return SeenMeasure(self, measure, matter)


class SeenMeasure(BoundObserver):
    """The quantity of a track with a single moment."""

    def __init__(self, spec: Measured, measure: Any, matter: Matter) -> None:
        self.measure, self.rows, self.size = measure, measure.rows, len(measure.components)
        self.low, self.high = limits(spec.range, measure.low, measure.high)
        self.control_step = matter.control_step

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        return self.measure.values(self._track(moment))[0], np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        bar = self.measure.values_vjp(self._track(moment), z_bar[None])
        return MomentBar(**{name: part[0] for name in "xvCF" if (part := getattr(bar, name)) is not None})

    def _track(self, moment: Moment) -> Track:
        x, v, C, F = moment.x[None], moment.v[None], moment.C[None], moment.F[None]
        return Track(x, v, C, F, np.zeros((0, 0)), moment.goals, self.control_step)

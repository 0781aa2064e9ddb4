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

OF_NOW = ("x", "v", "C", "F", "activation")
"""The parts of a track that have a row for each moment."""

OF_PARTS = ("strength", "rest_length", "friction")
"""Those that have a number for each part of actuators and forces."""


@plugin("observer", "measured")
class Measured(Observer):
    """A quantity of the section `measure`, such as a bend angle or the force on a rigid body: all its components.

    It is that at the moment of the control step. A reaction is the mean over the control step before, zero at the
    start; a tension or a pressure is that with the activation before, at the start the one that does nothing. Work,
    energies and stresses are not seen.
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
                f"a controller cannot see '{self.quantity}' ({measure.meaning}): it sees no work, energy or stress; it "
                "sees positions, displacements, velocities, rotations, distances, bend angles, strains, stretches, "
                "motions of rigid bodies, reactions, cables and chambers"
            )
        return SeenMeasure(self, measure, matter)


class SeenMeasure(BoundObserver):
    """The quantity of a track with a single moment; reactions, which row 0 of a track does not have, are in row 1."""

    def __init__(self, spec: Measured, measure: Any, matter: Matter) -> None:
        self.measure, self.rows, self.size = measure, measure.rows, len(measure.components)
        self.low, self.high = limits(spec.range, measure.low, measure.high)
        self.control_step = matter.control_step

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        return self.measure.values(self._track(moment))[-1], np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        track = self._track(moment)
        values_bar = np.zeros(self.measure.values(track).shape)
        values_bar[-1] = z_bar
        bar = self.measure.values_vjp(track, values_bar)
        now = {name: part[-1] for name in OF_NOW if (part := getattr(bar, name)) is not None}
        rigid, held = (_last(bars) for bars in (bar.rigid, bar.held))
        return MomentBar(**now, rigid=rigid, held=held, **{name: getattr(bar, name) for name in OF_PARTS})

    def _track(self, moment: Moment) -> Track:
        x, v, C, F = moment.x[None], moment.v[None], moment.C[None], moment.F[None]
        return Track(
            x, v, C, F, moment.activation[None], moment.goals, self.control_step,
            held={name: np.stack([0.0 * row, row]) for name, row in moment.held.items()}, strength=moment.strength,
            rest_length=moment.rest_length, friction=moment.friction,
            rigid={name: row[None] for name, row in moment.rigid.items()},
        )  # fmt: skip


def _last(bars: dict[str, Array] | None) -> dict[str, Array] | None:
    """Return the last row of each of several cotangents."""
    return None if bars is None else {name: rows[-1] for name, rows in bars.items()}

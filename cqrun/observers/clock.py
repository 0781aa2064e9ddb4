"""Time, or the phase of a rhythm."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.observers.matter import Matter
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import Range, limits
from cqrun.observers.rows import means
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("observer", "clock")
class Clock(Observer):
    """Phase of a rhythm: sin and cos of 2 pi k t / period, k = 1 .. harmonics. Without a period: the time t [s]."""

    period: float | None = quantity(
        "s", "Period of the rhythm; if absent, the clock gives the time", gt=0, default=None
    )
    harmonics: int = Field(description="Number of harmonics, each a sine and a cosine", ge=1, le=1000, default=1)
    range: Range = Field(
        description="Range that is scaled to [-1, 1]; auto: -1 to 1, or 0 to the run's length without a period",
        default="auto",
    )

    @model_validator(mode="after")
    def _harmonics_need_a_period(self) -> Self:
        if self.period is None and self.harmonics > 1:
            raise complaint("Clock", [finding("has no meaning without a period: give one", ("harmonics",))])
        return self

    def bind(self, matter: Matter) -> BoundObserver:
        return ClockReading(self, matter)


class ClockReading(BoundObserver):
    """A clock needs no particles, and nothing flows back."""

    def __init__(self, clock: Clock, matter: Matter) -> None:
        self.rows = means([], matter.n_particles)
        self.rates: Array | None = None
        low, high = np.zeros(1), np.array([matter.duration])
        if clock.period is not None:
            self.rates = 2 * np.pi / clock.period * np.arange(1, clock.harmonics + 1)
            low, high = np.full(2 * clock.harmonics, -1.0), np.full(2 * clock.harmonics, 1.0)
        self.size = len(low)
        self.low, self.high = limits(clock.range, low, high)

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        if self.rates is None:
            return np.array([moment.time]), np.zeros(0)
        phase = self.rates * moment.time
        return np.stack([np.sin(phase), np.cos(phase)], axis=1).reshape(-1), np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        return MomentBar()

"""Effort of the actuators."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.explain import listed
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("objective", "effort")
class Effort(ObjectiveTerm):
    """Effort [s]: the integral over time of u^T u, the sum of the squares of all activations.

    A cable with a `stiffness` pulls most at an activation of 0 and does nothing at 1. With `counted_from: neutral` a
    slack cable costs nothing.
    """

    least: ClassVar[float] = 0.0

    over: Over = Field(description="How the values of all control steps are combined", default="sum")
    counted_from: Literal["zero", "neutral"] | None = Field(
        description="Activation that costs nothing: zero, as in the papers and if absent; or neutral, the one at which "
        "the actuator does nothing",
        default=None,
    )

    def likely_mistakes(self, neutral: Mapping[str, float]) -> Iterator[tuple[str, str]]:
        others = [f"{name}: {at:g}" for name, at in neutral.items() if at != 0.0]
        if self.counted_from is None and others:
            yield (
                "counted_from",
                f"counts from zero, but actuators do nothing at another activation ({listed(others)}): say "
                "`counted_from: neutral`, so that doing nothing costs nothing, or `counted_from: zero` to keep it",
            )

    def bind(self, matter: Matter) -> BoundTerm:
        return SquaredActivation(self, matter)


class SquaredActivation(BoundTerm):
    """u^T u of every control step."""

    def __init__(self, spec: Effort, matter: Matter) -> None:
        self.rows = means([], matter.n_particles)
        self.over = spec.over
        self.origin: Array | float = matter.neutral if spec.counted_from == "neutral" else 0.0

    def steps(self, track: Track) -> Array:
        return np.asarray(np.sum((track.activation - self.origin) ** 2, axis=1))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        return TrackBar(activation=2.0 * h_bar[:, None] * (track.activation - self.origin))

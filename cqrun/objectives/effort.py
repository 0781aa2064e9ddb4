"""What a controller spends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.explain import listed
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over, Track, TrackBar
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("objective", "effort")
class Effort(ObjectiveTerm):
    """Effort [s]: the integral over time of u^T u, the sum of all activations' squares.

    A cable pulls most at an activation of 0 and does nothing at 1: with `counted_from: neutral` slack ones are free.
    """

    least: ClassVar[float] = 0.0

    over: Over = Field(description="How the values of all control steps become one", default="sum")
    counted_from: Literal["zero", "neutral"] | None = Field(
        description="Where an activation costs nothing: at zero, as in the papers, and if absent; or at neutral, each "
        "actuator's own at which it does nothing",
        default=None,
    )

    def doubts(self, neutral: Mapping[str, float]) -> Iterator[tuple[str, str]]:
        odd = [f"{name}: {at:g}" for name, at in neutral.items() if at != 0.0]
        if self.counted_from is None and odd:
            yield (
                "counted_from",
                f"counts from zero, but what does nothing is another activation ({listed(odd)}): say `counted_from: "
                "neutral`, so that doing nothing costs nothing, or `counted_from: zero` if zero is meant",
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

"""What a scene says about learning: goals and episodes."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.plugin.contract import Array, Spec, quantity
from cqrun.scene.fields import Seed


class Goal(Spec):
    """Numbers that an episode is about, such as a position; drawn from a range where there is a spread."""

    position: list[float] = quantity("m", "Goal, or the middle of its range", min_length=1)
    spread: list[float] | None = quantity(
        "m", "Half the range of each entry; drawn evenly from it, once an episode", default=None
    )

    @model_validator(mode="after")
    def _as_long(self) -> Self:
        if self.spread is not None and len(self.spread) != len(self.position):
            message = f"must have {len(self.position)} entries, as the position, has {len(self.spread)}"
            raise complaint("Goal", [finding(message, ("spread",))])
        if any(a < 0 for a in self.spread or []):
            raise complaint("Goal", [finding("must not be negative: it is half a range", ("spread",))])
        return self

    @property
    def drawn(self) -> bool:
        """Whether it differs from episode to episode."""
        return any(self.spread or [])

    def draw(self, rng: np.random.Generator) -> Array:
        """Return the goal of one episode (n,)."""
        middle, spread = np.array(self.position), np.array(self.spread or np.zeros(len(self.position)))
        return np.asarray(middle + spread * rng.uniform(-1.0, 1.0, len(spread)))


class Episodes(Spec):
    """How many rollouts an iteration has, each with goals of its own."""

    count: int = Field(description="Episodes of an iteration, or in the fixed set", ge=1, default=1)
    fresh: bool = Field(description="Draw new goals at every iteration; else one set for the whole run", default=False)
    unseen: int = Field(description="Episodes with other goals that the result is tested on", ge=0, default=0)
    seed: Seed = Field(description="Seed of the goals", default=0)

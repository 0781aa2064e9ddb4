"""Sections `goals` and `episodes`: what a controller learns."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.plugin.contract import Array, Spec, quantity
from cqrun.scene.fields import Seed


class Goal(Spec):
    """A goal of an episode, such as a position; it is drawn from a range if it has a spread."""

    position: list[float] = quantity("m", "The goal, or the middle of its range", min_length=1)
    spread: list[float] | None = quantity(
        "m", "Half the range of each entry; the goal is drawn uniformly, once per episode", default=None
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
        """Whether the goal differs from episode to episode."""
        return any(self.spread or [])

    def draw(self, rng: np.random.Generator) -> Array:
        """Return the goal of one episode (n,)."""
        middle, spread = np.array(self.position), np.array(self.spread or np.zeros(len(self.position)))
        return np.asarray(middle + spread * rng.uniform(-1.0, 1.0, len(spread)))


class Episodes(Spec):
    """The number of rollouts in an iteration, each with its own goals."""

    count: int = Field(description="Episodes per iteration, or in the fixed set", ge=1, default=1)
    fresh: bool = Field(
        description="Draw new goals in every iteration; otherwise one set for the whole run", default=False
    )
    unseen: int = Field(description="Episodes with other goals, on which the result is tested", ge=0, default=0)
    seed: Seed = Field(description="Seed of the goals", default=0)

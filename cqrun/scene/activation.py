"""Section `activation`: open-loop signals of the actuators, from given or random knots."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.plugin.contract import Spec, quantity
from cqrun.plugin.reference import NamesActuator
from cqrun.scene.data import exactly_one
from cqrun.scene.fields import Name, Seed


class RandomActivation(Spec):
    """Random sequences of knots, for synthetic data."""

    sequences: int = Field(description="Number of sequences", ge=1, le=10_000)
    knots: int = Field(description="Knots per sequence, spread evenly over the run", ge=1)
    low: float = quantity("1", "Smallest activation", default=0.0)
    high: float = quantity("1", "Largest activation", default=1.0)
    seed: Seed = Field(description="Seed of the knots", default=0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            message = f"must be greater than low, is {self.high:g}"
            raise complaint("RandomActivation", [finding(message, ("high",), involves=("low",))])
        return self


Knots = Annotated[list[float], Field(min_length=1)]


class Activation(Spec):
    """Open-loop signals of the actuators: given knots, or random ones."""

    signals: dict[Annotated[Name, NamesActuator()], Knots] | None = quantity(
        "1", "Actuator -> knots, spread evenly over time", differentiable=True, default=None
    )
    random: RandomActivation | None = Field(description="Random sequences", default=None)
    interpolate: Literal["hold", "linear"] = Field(description="Interpolation between knots", default="hold")
    over: float | None = quantity(
        "s",
        "Time over which the knots are spread, after which the last knot is held; the run's duration if absent",
        gt=0,
        default=None,
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        exactly_one(self, ("signals", "random"))
        return self

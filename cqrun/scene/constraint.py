"""Section `constraints`: bounds on a term of an objective."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.objectives.term import ObjectiveTerm
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Spec

ENDS = ("at_least", "at_most", "equals")

LOOSE = 0.5
"""A constraint has almost no effect if its tolerance is more than this part of its bound."""


class Constraint(Spec):
    """A quantity of a motion or of a design, and its bounds."""

    of: Annotated[Chosen[ObjectiveTerm], Choice("objective")] = Field(
        description="The constrained quantity: any term of an objective"
    )
    at_least: float | None = Field(description="Lower bound, in the term's unit", default=None)
    at_most: float | None = Field(description="Upper bound, in the term's unit", default=None)
    equals: float | None = Field(description="Required value, in the term's unit", default=None)
    scale: float = Field(description="Unit in which violations are measured", gt=0, default=1.0)

    @model_validator(mode="after")
    def _has_ends(self) -> Self:
        given = [name for name in ENDS if getattr(self, name) is not None]
        if not given or ("equals" in given and len(given) > 1):
            message = "needs `at_least`, `at_most` or both, or else `equals`"
            raise complaint("Constraint", [finding(message, involves=given)])
        if self.of.value.weight != 1.0:
            message = "a constraint has no weight: its violation is measured in units of its `scale`"
            raise complaint("Constraint", [finding(message, ("of", self.of.name, "weight"))])
        if len(given) == 2 and not self.low < self.high:
            message = f"no value is allowed: at_least {self.low:g} is not below at_most {self.high:g}"
            raise complaint("Constraint", [finding(message, ("at_most",), involves=("at_least",))])
        if self.high < self.of.value.least:
            end = "at_most" if self.at_most is not None else "equals"
            message = f"{self.high:g} can never be met: no {self.of.name} is below {self.of.value.least:g}"
            raise complaint("Constraint", [finding(message, (end,))])
        return self

    def loose_end(self, tolerance: float) -> str | None:
        """Return the name of a bound that a tolerance, in units of the scale, makes meaningless, or None."""
        sizes = {name: abs(end) for name in ENDS if (end := getattr(self, name))}  # an end of 0 has no size
        smallest = min(sizes, key=lambda name: sizes[name], default="")
        return smallest if smallest and tolerance * self.scale > LOOSE * sizes[smallest] else None

    @property
    def low(self) -> float:
        """The lower bound; -inf if there is none."""
        ends = [end for end in (self.at_least, self.equals) if end is not None]
        return ends[0] if ends else -np.inf

    @property
    def high(self) -> float:
        """The upper bound; inf if there is none."""
        ends = [end for end in (self.at_most, self.equals) if end is not None]
        return ends[0] if ends else np.inf

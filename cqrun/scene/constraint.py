"""What a scene says must hold: a term of an objective between ends."""

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
"""Part of an end; a constraint that counts as met further from it is hardly one."""


class Constraint(Spec):
    """A quantity of a motion or of a design, and the ends between which it must be."""

    of: Annotated[Chosen[ObjectiveTerm], Choice("objective")] = Field(
        description="What is held: any term of an objective"
    )
    at_least: float | None = Field(description="Least value, in the term's unit", default=None)
    at_most: float | None = Field(description="Greatest value, in the term's unit", default=None)
    equals: float | None = Field(description="The value itself, in the term's unit", default=None)
    scale: float = Field(description="Violations are judged in units of this", gt=0, default=1.0)

    @model_validator(mode="after")
    def _has_ends(self) -> Self:
        given = [name for name in ENDS if getattr(self, name) is not None]
        if not given or ("equals" in given and len(given) > 1):
            told = "needs `at_least`, `at_most` or both, or else `equals`"
            raise complaint("Constraint", [finding(told, involves=given)])
        if self.of.value.weight != 1.0:
            told = "a constraint has no weight: its violation is judged in units of its `scale`"
            raise complaint("Constraint", [finding(told, ("of", self.of.name, "weight"))])
        if len(given) == 2 and not self.low < self.high:
            message = f"leaves nothing: at_least {self.low:g} is not below at_most {self.high:g}"
            raise complaint("Constraint", [finding(message, ("at_most",), involves=("at_least",))])
        if self.high < self.of.value.least:
            end = "at_most" if self.at_most is not None else "equals"
            told = f"{self.high:g} can never be met: no {self.of.name} is below {self.of.value.least:g}"
            raise complaint("Constraint", [finding(told, (end,))])
        return self

    def loose_end(self, tolerance: float) -> str | None:
        """Return the name of an end that `tolerance`, in units of the scale, makes next to nothing; None without."""
        sizes = {name: abs(end) for name in ENDS if (end := getattr(self, name))}  # an end of 0 has no size
        smallest = min(sizes, key=lambda name: sizes[name], default="")
        return smallest if smallest and tolerance * self.scale > LOOSE * sizes[smallest] else None

    @property
    def low(self) -> float:
        """The least value, -inf without one."""
        ends = [end for end in (self.at_least, self.equals) if end is not None]
        return ends[0] if ends else -np.inf

    @property
    def high(self) -> float:
        """The greatest value, inf without one."""
        ends = [end for end in (self.at_most, self.equals) if end is not None]
        return ends[0] if ends else np.inf

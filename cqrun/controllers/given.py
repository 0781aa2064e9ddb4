"""Given: a table of activations over time that nothing changes, so that a body alone is designed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.controllers.controller import Controller, ParameterBlock
from cqrun.controllers.open_loop import knots_at
from cqrun.errors import UsageError
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("controller", "given")
class Given(Controller):
    """A table of activations over time that is given, and not learned: `cqrun codesign` then designs the body alone.

    Each row of `knots` has one activation for each actuator, and `every` control steps lie between two rows. After the
    last, its activations are held. Observations are not used. With `start: equilibrium` the first row acts there, so a
    run of a single short control step designs a body at rest.
    """

    bounded: ClassVar[bool] = False
    closed_loop: ClassVar[bool] = False
    learned: ClassVar[bool] = False

    knots: list[Annotated[list[float], Field(min_length=1)]] = quantity(
        "1", "Rows over time, with the activation of each actuator", min_length=1
    )
    every: int = Field(description="Control steps from one knot to the next", ge=1, default=1)
    interpolate: Literal["hold", "linear"] = Field(
        description="Activations between knots: hold the last knot, or linear", default="hold"
    )

    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        for k, row in enumerate(self.knots):
            if len(row) != n_out:
                have = f"{len(row)} activation{'s' * (len(row) > 1)}"
                raise UsageError(f"knots.{k} has {have}, and there {'is' if n_out == 1 else 'are'} {n_out} to drive")
            if not np.all((low <= np.array(row)) & (np.array(row) <= high)):
                raise UsageError(f"knots.{k} is {row}, which is out of an actuator's range")
        return []

    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        at = knots_at(len(self.knots), control, self.every, self.interpolate)
        return np.asarray(sum(weight * np.array(self.knots[k], float) for k, weight in at))

    def act_vjp(
        self, parameters: Mapping[str, Array], z: Array, control: int, time: float, u_bar: Array, out: dict[str, Array]
    ) -> Array:
        return np.zeros(len(z))

"""A controller of your own: it turns observations into a number for each actuator, in every control step.

Here it is a linear law within limits, u = tanh(W z). Change `act` to your law, and `act_vjp` to its adjoint:
`cqrun gradcheck my_controller.yaml --allow-plugins` checks that the two agree.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from cqrun.controllers.controller import Controller, ParameterBlock
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("controller", "my_controller")
class MyController(Controller):
    """u = tanh(W z) of the observations z; u in [-1, 1] is mapped to the range of each actuator.

    This text is the page of the controller: `cqrun describe controller my_controller --plugin my_controller.py`.
    """

    spread: float = Field(description="Standard deviation of the initial weights", ge=0, default=0.1)

    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        """Return the parameters that are learned, with their initial values."""
        self.require_observations(n_in)
        return [ParameterBlock("weights", self.spread * rng.normal(size=(n_out, n_in)))]

    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        """Return a number for each actuator (A,), from the observations z and the time [s]."""
        return np.asarray(np.tanh(parameters["weights"] @ z))

    def act_vjp(
        self,
        parameters: Mapping[str, Array],
        z: Array,
        control: int,
        time: float,
        u_bar: Array,
        out: dict[str, Array],
    ) -> Array:
        """Return the cotangent of z from that of the result; add those of the parameters to `out`."""
        u = np.tanh(parameters["weights"] @ z)
        sum_bar = u_bar * (1.0 - u * u)
        out["weights"] += np.outer(sum_bar, z)
        return np.asarray(parameters["weights"].T @ sum_bar)

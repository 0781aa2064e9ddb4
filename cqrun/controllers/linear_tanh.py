"""One layer: tanh(W z + b), CQ1's controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.controllers.controller import Controller, ParameterBlock
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("controller", "linear_tanh")
class LinearTanh(Controller):
    """u = gain tanh(W z + b) of observations z, as in CQ1.

    W starts from a normal distribution with standard deviation `spread`, b from zero.
    """

    initial_fields: ClassVar[tuple[str, ...]] = ("spread",)
    gain: float = Field(description="Largest |u|: the share of the actuators' ranges in use", gt=0, le=1, default=1.0)
    spread: float = Field(description="Standard deviation of the initial weights", ge=0, default=0.02)

    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        self.require_observations(n_in)
        self.require_few(float(n_in) * n_out, f"{n_in} observations for {n_out} actuators")
        weights = self.spread * rng.normal(size=(n_out, n_in))
        return [ParameterBlock("weights", weights), ParameterBlock("biases", np.zeros(n_out))]

    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        return np.asarray(self.gain * np.tanh(parameters["weights"] @ z + parameters["biases"]))

    def act_vjp(
        self,
        parameters: Mapping[str, Array],
        z: Array,
        control: int,
        time: float,
        u_bar: Array,
        out: dict[str, Array],
    ) -> Array:
        u = np.tanh(parameters["weights"] @ z + parameters["biases"])
        sum_bar = self.gain * u_bar * (1.0 - u * u)
        out["weights"] += np.outer(sum_bar, z)
        out["biases"] += sum_bar
        return np.asarray(parameters["weights"].T @ sum_bar)

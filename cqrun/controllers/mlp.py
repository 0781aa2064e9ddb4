"""A multi-layer perceptron, CQ2's controller."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.controllers.controller import Controller, ParameterBlock
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

Width = Annotated[int, Field(ge=1)]


@plugin("controller", "mlp")
class Mlp(Controller):
    """Hidden layers, relu(W z + b) or tanh(W z + b), then u = tanh(W z + b); CQ2 has two of 64 with relu.

    Initial weights have a normal distribution, with variance 2 / inputs before a relu (He et al. 2015) and
    2 / (inputs + outputs) before a tanh (Glorot and Bengio 2010). Those of the output layer are multiplied by
    `output_spread`. Biases start at zero. The derivative of relu at 0 is taken as 0.
    """

    unit_inputs: ClassVar[bool] = True
    initial_fields: ClassVar[tuple[str, ...]] = ("output_spread",)
    hidden: list[Width] = Field(description="Width of each hidden layer", default=[64, 64])
    activation: Literal["relu", "tanh"] = Field(description="Activation function of the hidden layers", default="relu")
    output_spread: float = Field(
        description="Factor on the output layer's initial weights; if small, the robot starts to move gently",
        gt=0, default=1.0,
    )  # fmt: skip

    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        self.require_observations(n_in)
        widths, blocks = [n_in, *self.hidden, n_out], []
        pairs = [(float(inputs), float(outputs)) for inputs, outputs in itertools.pairwise(widths)]
        self.require_few(sum((1.0 + inputs) * outputs for inputs, outputs in pairs), "the weights of all layers")
        for k, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
            last = k == len(self.hidden)
            relu = self.activation == "relu" and not last
            spread = np.sqrt(2.0 / (inputs if relu else inputs + outputs)) * (self.output_spread if last else 1.0)
            blocks.append(ParameterBlock(f"weights{k}", spread * rng.normal(size=(outputs, inputs))))
            blocks.append(ParameterBlock(f"biases{k}", np.zeros(outputs)))
        return blocks

    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        return self._layers(parameters, z)[-1]

    def act_vjp(
        self,
        parameters: Mapping[str, Array],
        z: Array,
        control: int,
        time: float,
        u_bar: Array,
        out: dict[str, Array],
    ) -> Array:
        layers = self._layers(parameters, z)
        bar = u_bar
        for k in reversed(range(len(layers) - 1)):
            value = layers[k + 1]
            relu = self.activation == "relu" and k < len(self.hidden)
            bar = np.where(value > 0, bar, 0.0) if relu else bar * (1.0 - value * value)
            out[f"weights{k}"] += np.outer(bar, layers[k])
            out[f"biases{k}"] += bar
            bar = parameters[f"weights{k}"].T @ bar
        return np.asarray(bar)

    def _layers(self, parameters: Mapping[str, Array], z: Array) -> list[Array]:
        """Return z and the output of each layer."""
        layers = [z]
        for k in range(len(self.hidden) + 1):
            total = parameters[f"weights{k}"] @ layers[-1] + parameters[f"biases{k}"]
            relu = self.activation == "relu" and k < len(self.hidden)
            layers.append(np.where(total.real > 0, total, 0.0) if relu else np.tanh(total))
        return layers

"""Sinusoids: a central pattern generator, as in CQ1's crawler."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.controllers.controller import Controller, ParameterBlock
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("controller", "sinusoid")
class Sinusoid(Controller):
    """u_j = gain tanh(sum_k W_jk sin(2 pi f t + phase_k) + b_j), with phase_k = 2 pi k / count for k = 0 .. count - 1.

    Observations are not used. Phases and the frequency f are fixed, unless `learn` names them. W starts from a normal
    distribution with standard deviation `spread`, b from zero. CQ1's crawler has count 8 and a phase of 0.06 rad per
    step of 5 ms, which is 1.91 Hz.
    """

    closed_loop: ClassVar[bool] = False
    initial_fields: ClassVar[tuple[str, ...]] = ("spread",)

    count: int = Field(description="Number of sinusoids", ge=1, default=8)
    frequency: float = quantity("Hz", "Frequency f of all of them", gt=0)
    learn: list[Literal["phase", "frequency"]] = Field(
        description="Parameters that are learned besides W and b", default_factory=list[Literal["phase", "frequency"]]
    )
    gain: float = Field(description="Largest |u|: the share of the actuators' ranges in use", gt=0, le=1, default=1.0)
    spread: float = Field(description="Standard deviation of the initial weights", ge=0, default=0.02)

    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        self.require_few(float(self.count) * n_out, f"{self.count:.3g} sinusoids for {n_out} actuators")
        blocks = [
            ParameterBlock("weights", self.spread * rng.normal(size=(n_out, self.count))),
            ParameterBlock("biases", np.zeros(n_out)),
        ]
        if "phase" in self.learn:
            blocks.append(ParameterBlock("phase", self._phases()))
        if "frequency" in self.learn:
            blocks.append(ParameterBlock("frequency", np.array([self.frequency]), lower=0.0))
        return blocks

    def likely_mistakes(self, control_step: float) -> Iterator[tuple[str, str]]:
        highest = 0.5 / control_step
        if self.frequency > highest:
            message = (
                f"{self.frequency:g} Hz is above {highest:g} Hz, half the rate of control steps of {control_step:g} s: "
                "actuators would see a slower wave (aliasing); lower it, or shorten time.control_step"
            )
            yield "frequency", message

    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        waves = np.sin(self._angles(parameters, time))
        return np.asarray(self.gain * np.tanh(parameters["weights"] @ waves + parameters["biases"]))

    def act_vjp(
        self,
        parameters: Mapping[str, Array],
        z: Array,
        control: int,
        time: float,
        u_bar: Array,
        out: dict[str, Array],
    ) -> Array:
        angles = self._angles(parameters, time)
        waves = np.sin(angles)
        u = np.tanh(parameters["weights"] @ waves + parameters["biases"])
        sum_bar = self.gain * u_bar * (1.0 - u * u)
        out["weights"] += np.outer(sum_bar, waves)
        out["biases"] += sum_bar
        angles_bar = np.cos(angles) * (parameters["weights"].T @ sum_bar)
        if "phase" in self.learn:
            out["phase"] += angles_bar
        if "frequency" in self.learn:
            out["frequency"] += 2 * np.pi * time * angles_bar.sum()
        return np.zeros(len(z))

    def _phases(self) -> Array:
        return np.asarray(2 * np.pi * np.arange(self.count) / self.count)

    def _angles(self, parameters: Mapping[str, Array], time: float) -> Array:
        """Return the argument of each sine (count,) [rad]."""
        frequency = parameters["frequency"] if "frequency" in self.learn else self.frequency
        phases = parameters["phase"] if "phase" in self.learn else self._phases()
        return np.asarray(2 * np.pi * frequency * time + phases)

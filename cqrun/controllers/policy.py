"""Observers, a controller and the actuators' limits as one policy (`engine/policy.py`).

    z = observe(sight, memory),  u = controller(z, t),  a_k = limited(u mapped to the limits, a_{k-1})

The memory is that of the observers. If an actuator has a rate, the activations of the previous control step follow; at
the first control step these are the activations that do nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from cqrun.actuators.actuator import within_limits
from cqrun.controllers.controller import Controller
from cqrun.engine.policy import Sight, SightBar
from cqrun.observers.observer import Moment, MomentBar, Observation
from cqrun.plugin.contract import Array
from cqrun.state import State, state_table


@dataclass(frozen=True)
class Limits:
    """Limits of the activations, each (A,).

    Attributes:
        low, high: smallest and largest activation.
        change: largest change in a control step; infinite for an actuator without a rate.
        neutral: activations that do nothing, or as little as possible: those before the first control step.
    """

    low: Array
    high: Array
    change: Array
    neutral: Array

    @property
    def slow(self) -> bool:
        """Whether an actuator has a rate, so that the previous activations are part of the memory."""
        return bool(np.isfinite(self.change).any())


def memory_size(observation: Observation, limits: Limits) -> int:
    """Return the size M of a policy's memory: that of the observers, and activations if an actuator has a rate."""
    return observation.n_memory + len(limits.low) * limits.slow


class ControlPolicy:
    """Decides the activations of one rollout.

    Args:
        observation: the observers; their rows are the first of the probe.
        controller: computes activations from observations.
        parameters: parameters of the controller, by block.
        limits: limits of the actuators.
        goals: goals of this episode, by name.
        control_step: length of a control step [s].
        dim: dimension of the world.

    Attributes:
        memory: (M,) memory at the start.
        observations: observations (Z,) that the controller was given, one entry for each control step so far.
    """

    def __init__(
        self, observation: Observation, controller: Controller, parameters: Mapping[str, Array], limits: Limits,
        goals: Mapping[str, Array], control_step: float, dim: int,
    ) -> None:  # fmt: skip
        self.observation, self.controller, self.parameters = observation, controller, parameters
        self.limits, self.goals, self.control_step, self.dim = limits, goals, control_step, dim
        self.observations: list[Array] = []
        self.slow = limits.slow
        self.memory = np.zeros(memory_size(observation, limits))
        if self.slow:
            self.memory[observation.n_memory :] = limits.neutral
        half = 0.5 * (limits.high - limits.low)
        self._scale, self._shift = (half, limits.low + half) if controller.bounded else (np.ones_like(half), 0.0 * half)

    def act(self, control: int, sight: Sight, memory: Array, state: Callable[[], State]) -> tuple[Array, Array]:
        """Return the activations (A,) of a control step, and the next memory (M,)."""
        z, observers_memory = self.observe(control, sight, memory, state)
        self.observations.append(z)
        u = self.controller.act(self.parameters, z, control, control * self.control_step)
        return self.activate(u, observers_memory, memory)

    def observe(self, control: int, sight: Sight, memory: Array, state: Callable[[], State]) -> tuple[Array, Array]:
        """Return the observations (Z,), and the observers' next memory."""
        return self.observation.observe(self._moment(control, sight, memory, state))

    def activate(self, u: Array, observers_memory: Array, memory: Array) -> tuple[Array, Array]:
        """Return the activations (A,) for the controller's output u (A,), and the next memory (M,)."""
        activation, _, _ = self._limited(u, memory)
        return activation, np.concatenate([observers_memory, activation]) if self.slow else observers_memory

    def act_vjp(
        self, control: int, sight: Sight, memory: Array, state: Callable[[], State], activation_bar: Array,
        memory_bar: Array, parameters_bar: dict[str, Array],
    ) -> tuple[SightBar, Array, State | None]:  # fmt: skip
        """Return the cotangents of sight, memory and state; add those of the parameters to `parameters_bar`."""
        moment, time = self._moment(control, sight, memory, state), control * self.control_step
        z, _ = self.observation.observe(moment)
        _, by_wanted, by_previous = self._limited(self.controller.act(self.parameters, z, control, time), memory)
        n = self.observation.n_memory
        total_bar = activation_bar + memory_bar[n:] if self.slow else activation_bar
        z_bar = self.controller.act_vjp(
            self.parameters, z, control, time, by_wanted * total_bar * self._scale, parameters_bar
        )
        bar = self.observation.observe_vjp(moment, z_bar, memory_bar[:n])
        out = np.zeros_like(memory_bar)
        if bar.memory is not None:
            out[:n] = bar.memory
        if self.slow:
            out[n:] = by_previous * total_bar
        return self._sight_bar(sight, bar), out, bar.state

    def parameters_zero(self) -> dict[str, Array]:
        """Return zero cotangents of the controller's parameters, by block."""
        return {name: np.zeros_like(value) for name, value in self.parameters.items()}

    def _limited(self, u: Array, memory: Array) -> tuple[Array, Array, Array]:
        """Return activations within the limits, and their derivatives by the unlimited and by the previous ones."""
        limits = self.limits
        previous = memory[self.observation.n_memory :] if self.slow else limits.neutral
        return within_limits(self._shift + self._scale * u, previous, limits.low, limits.high, limits.change)

    def _moment(self, control: int, sight: Sight, memory: Array, state: Callable[[], State]) -> Moment:
        D, k = self.dim, self.observation.rows.shape[0]
        fields, sums = state_table(D).fields, sight.rows[:, :k].T
        x, v, C, F = (sums[:, state_table(D).rows[f.name]].reshape(k, *f.shape) for f in fields)
        return Moment(
            x, v, C, F, control * self.control_step, control, self.goals, memory[: self.observation.n_memory], state,
            sight.rigid, sight.held, sight.activation if control > 0 else self.limits.neutral, sight.strength,
            sight.rest_length, sight.friction,
        )  # fmt: skip

    def _sight_bar(self, sight: Sight, bar: MomentBar) -> SightBar:
        """Return the cotangent of what is seen from that of a moment."""
        k, out = self.observation.rows.shape[0], np.zeros(sight.rows.shape)
        for name, rows in state_table(self.dim).rows.items():
            part = getattr(bar, name)
            if part is not None:
                out[rows, :k] = part.reshape(k, -1).T
        return SightBar(out, bar.rigid, bar.held, bar.activation, bar.strength, bar.rest_length, bar.friction)

"""The policy of a rollout: observers and a controller, as the engine sees them.

At the start of a control step the engine calls the policy with what it sees and with the policy's memory. It returns
the activations of the control step and the next memory. The backward run calls its adjoint in reverse order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.state import State


def _none() -> Array:
    return np.zeros(0)


@dataclass
class Sight:
    """What a policy sees at the start of control step k, without unpacking the state.

    Attributes:
        rows: (rows, K) the probe's record of x, v, C and F, row-major.
        rigid: rigid body -> displacement, rotation vector (2D: angle), velocity and angular velocity (6,) or (12,).
        held: boundary or rigid body -> force [N] and moment [N m] (D + 1,) or (6,) on the soft bodies: means over
            control step k - 1, zero for k = 0.
        activation: (A,) activations in control step k - 1, zero for k = 0.
        strength, rest_length, friction: (A',) of every part of actuators and forces, as in `Levels`.
    """

    rows: Array
    rigid: Mapping[str, Array] = field(default_factory=dict)
    held: Mapping[str, Array] = field(default_factory=dict)
    activation: Array = field(default_factory=_none)
    strength: Array = field(default_factory=_none)
    rest_length: Array = field(default_factory=_none)
    friction: Array = field(default_factory=_none)


@dataclass
class SightBar:
    """The cotangent of what a policy sees: rows (rows, K), and the rest by the same names; None is zero.

    For k = 0, nothing is done with those of `held` and `activation`, which are constants there.
    """

    rows: Array
    rigid: Mapping[str, Array] | None = None
    held: Mapping[str, Array] | None = None
    activation: Array | None = None
    strength: Array | None = None
    rest_length: Array | None = None
    friction: Array | None = None


class Policy(Protocol):
    """A map from what is seen and a memory (M,) to activations and the next memory.

    `state` unpacks the whole state, which takes time.
    """

    def act(self, control: int, sight: Sight, memory: Array, state: Callable[[], State]) -> tuple[Array, Array]:
        """Return the activations (A,) of a control step, and the next memory (M,)."""
        ...

    def act_vjp(
        self, control: int, sight: Sight, memory: Array, state: Callable[[], State], activation_bar: Array,
        memory_bar: Array, parameters_bar: Any,
    ) -> tuple[SightBar, Array, State | None]:  # fmt: skip
        """Return the cotangents of sight, memory and state (None for zero).

        Args:
            control, sight, memory, state: the arguments of `act`.
            activation_bar, memory_bar: cotangents of its results.
            parameters_bar: cotangents of the policy's parameters; it adds to them.
        """
        ...

    def parameters_zero(self) -> Any:
        """Return zero cotangents of the policy's parameters, which the engine only passes on."""
        ...

"""The policy of a rollout: observers and a controller, as the engine sees them.

At the start of a control step the engine calls the policy with the probe's record of the state and the policy's memory.
It returns the activations of the control step and the next memory. The backward run calls its adjoint in reverse order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from cqrun.plugin.contract import Array
from cqrun.state import State


class Policy(Protocol):
    """A map from a record (rows, K) of x, v, C, F, row-major, and a memory (M,) to activations and the next memory.

    `state` unpacks the whole state, which takes time.
    """

    def act(self, control: int, record: Array, memory: Array, state: Callable[[], State]) -> tuple[Array, Array]:
        """Return the activations (A,) of a control step, and the next memory (M,)."""
        ...

    def act_vjp(
        self, control: int, record: Array, memory: Array, state: Callable[[], State], activation_bar: Array,
        memory_bar: Array, parameters_bar: Any,
    ) -> tuple[Array, Array, State | None]:  # fmt: skip
        """Return the cotangents of record, memory and state (None for zero).

        Args:
            control, record, memory, state: the arguments of `act`.
            activation_bar, memory_bar: cotangents of its results.
            parameters_bar: cotangents of the policy's parameters; it adds to them.
        """
        ...

    def parameters_zero(self) -> Any:
        """Return zero cotangents of the policy's parameters, which the engine only passes on."""
        ...

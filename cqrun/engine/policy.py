"""What decides the activations of a rollout: observers and a controller, seen from the engine.

At the beginning of control step k the engine shows the policy what its probe recorded of the state, and what the
policy remembered; it answers with the activations of that control step and with what to remember. In the backward
run it is asked for the adjoint of that answer, last control step first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from cqrun.plugin.contract import Array
from cqrun.state import State


class Policy(Protocol):
    """A map from what is observed and remembered to activations and memory.

    `record` (rows, K) are the probe's rows of the state: x, v, C, F, row-major; `memory` (M,) is what was remembered;
    `state` gives the whole state, at the price of unpacking it.
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
            control, record, memory, state: as `act` had them.
            activation_bar, memory_bar: cotangents of what it returned.
            parameters_bar: the cotangents of its parameters, to which it adds.
        """
        ...

    def parameters_zero(self) -> Any:
        """Return cotangents of its parameters to begin with, which the engine only hands on."""
        ...

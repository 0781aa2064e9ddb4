"""What a controller is: at every control step it turns observations and time into one number an actuator.

Its parameters are arrays by name, kept outside: the same plug-in acts with any of them. A `bounded` controller
gives numbers in [-1, 1], which the caller maps to the actuators' ranges; another gives activations themselves.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cqrun.errors import UsageError
from cqrun.plugin.contract import Array, Plugin


@dataclass(frozen=True)
class ParameterBlock:
    """One array of parameters: where it starts, and its bounds (one for all entries, or each its own)."""

    name: str
    initial: Array
    lower: float | Array = -np.inf
    upper: float | Array = np.inf


class Controller(Plugin):
    """Base of the plug-ins of kind `controller`.

    `bounded`: it gives numbers in [-1, 1], not activations. `closed_loop`: it looks at observations.
    `unit_inputs`: what it starts with is for observations of about 1. `of_the_start`: fields that only say where its
    parameters start.
    """

    bounded: ClassVar[bool] = True
    closed_loop: ClassVar[bool] = True
    unit_inputs: ClassVar[bool] = False
    of_the_start: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        """Return the parameters, as they start.

        Args:
            n_in: number of observations.
            n_out: number of actuators A.
            n_controls: control steps in a run.
            low, high: (A,) the actuators' ranges.
            neutral: (A,) activations within them that do nothing, or as little as they may.
            rng: what random parameters are drawn from.

        Raises:
            UsageError: it does not fit these numbers.
        """

    @abstractmethod
    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        """Return one number an actuator (A,).

        Args:
            parameters: by the names of the blocks, of their shapes.
            z: (n_in,) observations.
            control: number of the control step, from 0; a replay may run past the last.
            time: since the start [s].
        """

    @abstractmethod
    def act_vjp(
        self,
        parameters: Mapping[str, Array],
        z: Array,
        control: int,
        time: float,
        u_bar: Array,
        out: dict[str, Array],
    ) -> Array:
        """Return the cotangent of z (n_in,) from that of the result, and add those of the parameters to `out`."""

    def doubts(self, control_step: float) -> Iterator[tuple[str, str]]:
        """Yield what is likely a slip: the field's name, and what is wrong with it.

        Args:
            control_step: time between two actions [s].
        """
        yield from ()

    def require_observations(self, n_in: int) -> None:
        """Refuse to act on nothing."""
        if n_in == 0:
            raise UsageError(
                f"the controller {self.name} acts on observations and there are none: add an observer, "
                "such as a clock, or take open_loop or sinusoid"
            )

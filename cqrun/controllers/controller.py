"""Base of controllers: at every control step a controller turns observations and time into a number for each actuator.

Its parameters are named arrays that are stored outside it, so the same plug-in can act with any of them. A `bounded`
controller returns numbers in [-1, 1], which the caller maps to the actuators' ranges. Others return activations.
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
    """One array of parameters: its initial values, and its bounds (one for all entries, or one for each)."""

    name: str
    initial: Array
    lower: float | Array = -np.inf
    upper: float | Array = np.inf


MOST_PARAMETERS = 10_000_000
"""Largest number of parameters of a controller: with a gradient and an optimizer's averages they fill gigabytes."""


class Controller(Plugin):
    """Base of the plug-ins of kind `controller`.

    `bounded`: it returns numbers in [-1, 1], not activations. `closed_loop`: it uses observations. `unit_inputs`: its
    initial parameters are meant for observations of about 1. `initial_fields`: fields that only set the initial
    parameters. `learned`: it has parameters. One without acts also in an equilibrium that a run starts from.
    """

    bounded: ClassVar[bool] = True
    closed_loop: ClassVar[bool] = True
    unit_inputs: ClassVar[bool] = False
    initial_fields: ClassVar[tuple[str, ...]] = ()
    learned: ClassVar[bool] = True

    @abstractmethod
    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        """Return the initial parameters.

        Args:
            n_in: number of observations.
            n_out: number of actuators A.
            n_controls: control steps in a run.
            low, high: (A,) the actuators' ranges.
            neutral: (A,) activations within these ranges that do nothing, or as little as possible.
            rng: generator for random parameters.

        Raises:
            UsageError: it does not fit these numbers.
        """

    @abstractmethod
    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        """Return a number for each actuator (A,).

        Args:
            parameters: arrays by the names of the blocks, with their shapes.
            z: (n_in,) observations.
            control: number of the control step, from 0; a replay may go on after the last.
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
        """Return the cotangent of z (n_in,) from that of the result; add those of the parameters to `out`."""

    def likely_mistakes(self, control_step: float) -> Iterator[tuple[str, str]]:
        """Yield likely mistakes: the name of the field, and what is wrong with it.

        Args:
            control_step: time between two actions [s].
        """
        yield from ()

    def require_observations(self, n_in: int) -> None:
        """Raise UsageError if there are no observations."""
        if n_in == 0:
            raise UsageError(
                f"the controller {self.name} acts on observations and there are none: add an observer, "
                "such as a clock, or take open_loop or sinusoid"
            )

    def require_few(self, parameters: float, of: str) -> None:
        """Raise UsageError if there are more parameters than can be learned; `of` says of what, in words."""
        if parameters > MOST_PARAMETERS:
            raise UsageError(
                f"the controller {self.name} would have {parameters:.3g} parameters ({of}), more than "
                f"{MOST_PARAMETERS:,}: make it smaller"
            )

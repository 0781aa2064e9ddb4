"""Open loop: a table of activations over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.controllers.controller import Controller, ParameterBlock
from cqrun.errors import UsageError
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("controller", "open_loop")
class OpenLoop(Controller):
    """A table of activations over time: a knot for each actuator every `every` control steps.

    Between knots activations are held or interpolated. Observations are not used. A replay that runs longer than the
    table holds the last knot.
    """

    bounded: ClassVar[bool] = False
    closed_loop: ClassVar[bool] = False
    initial_fields: ClassVar[tuple[str, ...]] = ("initial", "noise")

    every: int = Field(description="Control steps from one knot to the next", ge=1, default=1)
    interpolate: Literal["hold", "linear"] = Field(
        description="Activations between knots: hold the last knot, or linear", default="hold"
    )
    initial: float | None = quantity(
        "1", "Initial value of all knots; if absent, the activation that does nothing", default=None
    )
    noise: float = quantity("1", "Standard deviation of noise added to it, within the range", ge=0, default=0.0)

    def blocks(
        self, n_in: int, n_out: int, n_controls: int, low: Array, high: Array, neutral: Array, rng: np.random.Generator
    ) -> list[ParameterBlock]:
        if self.initial is not None and not np.all((low <= self.initial) & (self.initial <= high)):
            raise UsageError(
                f"open_loop starts at {self.initial:g}, which is out of an actuator's range; the ranges have "
                f"{np.max(low):g} to {np.min(high):g} in common"
            )
        intervals, rest = divmod(n_controls - 1, self.every)
        shape = (intervals + 1 + (self.interpolate == "linear" and rest > 0), n_out)
        self.require_few(float(shape[0]) * n_out, f"{shape[0]:.3g} knots for {n_out} actuators")
        initial = np.broadcast_to(neutral if self.initial is None else self.initial, shape)
        start = initial + self.noise * rng.normal(size=shape)
        low, high = np.broadcast_to(low, shape).copy(), np.broadcast_to(high, shape).copy()
        return [ParameterBlock("knots", np.clip(start, low, high), low, high)]

    def act(self, parameters: Mapping[str, Array], z: Array, control: int, time: float) -> Array:
        knots = parameters["knots"]
        at = knots_at(len(knots), control, self.every, self.interpolate)
        return np.asarray(sum(weight * knots[k] for k, weight in at))

    def act_vjp(
        self,
        parameters: Mapping[str, Array],
        z: Array,
        control: int,
        time: float,
        u_bar: Array,
        out: dict[str, Array],
    ) -> Array:
        for k, weight in knots_at(len(out["knots"]), control, self.every, self.interpolate):
            out["knots"][k] += weight * u_bar
        return np.zeros(len(z))


def knots_at(n_knots: int, control: int, every: int, interpolate: str) -> list[tuple[int, float]]:
    """Return the knots that act at a control step, with their weights; the last knot is held."""
    k, past = divmod(control, every)
    if interpolate == "hold" or past == 0 or k + 1 >= n_knots:
        return [(min(k, n_knots - 1), 1.0)]
    return [(k, 1.0 - past / every), (k + 1, past / every)]

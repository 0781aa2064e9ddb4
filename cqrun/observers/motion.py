"""How sets of particles move: position, velocity and acceleration of their centroids."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from cqrun.explain import shown
from cqrun.observers.matter import Matter
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import RAW, Range, limits
from cqrun.observers.rows import means
from cqrun.plugin.contract import Array, Spec
from cqrun.plugin.reference import BodyName

Quantity = Literal["position", "velocity", "acceleration"]


class MotionRanges(Spec):
    """Range of each quantity that is scaled to [-1, 1]."""

    position: Range = Field(
        description="[low, high] in m, or one pair for each axis; auto: the world's size; null: as it is",
        default="auto",
    )
    velocity: Range = Field(
        description="[low, high] in m/s, or one pair for each axis; auto: the world's size per s; null: as it is",
        default="auto",
    )
    acceleration: Range = Field(
        description="[low, high] in m/s^2, or one pair for each axis; auto: the world's size per s^2; null: as it is",
        default="auto",
    )


_ALL_RAW = MotionRanges(position=RAW, velocity=RAW, acceleration=RAW)


def _by_quantity(value: Any) -> Any:
    """Replace null and raw by the ranges they stand for; ValueError for a single range, which has no quantity."""
    if value is None or value == RAW:
        return _ALL_RAW
    if not isinstance(value, (dict, MotionRanges)):
        raise ValueError(
            "must have a range for each quantity, such as {position: [0, 1], velocity: [-1, 1]}, or be null (raw); is "
            f"{shown(value)}"
        )
    return value


class MotionObserver(Observer):
    """Base of observers of centroids."""

    body: BodyName = Field(description="Body that is observed")
    of: Annotated[list[Quantity], Field(min_length=1)] = Field(
        description="Quantities of each centroid, in this order", default=["position", "velocity"]
    )
    # null is stored as raw ranges, because a resolved scene does not contain null values
    range: Annotated[MotionRanges | None, BeforeValidator(_by_quantity)] = Field(
        description="Ranges that are scaled to [-1, 1], by quantity; null (raw): values as they are",
        default_factory=MotionRanges,
    )

    def motion(self, sets: Sequence[Array], matter: Matter) -> Motion:
        """Return the bound observer of these sets of particles."""
        return Motion(sets, self.of, self.range or _ALL_RAW, matter)


class Motion(BoundObserver):
    """Quantities of the plain means of G sets of particles, flattened from (G, quantities, D).

    The acceleration is the change of velocity since the previous control step, divided by the control step, and zero
    at the first. The memory is the velocity at the previous control step.
    """

    def __init__(self, sets: Sequence[Array], of: Sequence[Quantity], ranges: MotionRanges, matter: Matter) -> None:
        self.of, self.control_step = list(of), matter.control_step
        self.shape = (len(sets), len(of), matter.dim)
        self.size = int(np.prod(self.shape))
        self.rows = means(sets, matter.n_particles)
        self.n_memory = len(sets) * matter.dim if "acceleration" in of else 0
        size = np.asarray(matter.size, float)
        auto = {"position": (np.zeros(len(size)), size), "velocity": (-size, size), "acceleration": (-size, size)}
        ends = [limits(getattr(ranges, quantity), *auto[quantity]) for quantity in of]
        self.low, self.high = (np.tile(np.concatenate(side), len(sets)) for side in zip(*ends, strict=True))

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        values: dict[str, Any] = {"position": moment.x, "velocity": moment.v}
        if self.n_memory:
            previous_v = moment.memory.reshape(moment.v.shape)
            change = (moment.v - previous_v) / self.control_step
            values["acceleration"] = change if moment.control > 0 else np.zeros_like(change)
        z = np.stack([values[quantity] for quantity in self.of], axis=1)
        return z.reshape(-1), moment.v.reshape(-1) if self.n_memory else np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        bars = {"position": np.zeros(moment.x.shape), "velocity": np.zeros(moment.v.shape)}
        bars["acceleration"] = np.zeros(moment.v.shape)
        for k, quantity in enumerate(self.of):
            bars[quantity] += z_bar.reshape(self.shape)[:, k]
        v_bar = bars["velocity"]
        if not self.n_memory:
            return MomentBar(x=bars["position"], v=v_bar)
        change_bar = bars["acceleration"] / self.control_step if moment.control > 0 else np.zeros(v_bar.shape)
        v_bar = v_bar + memory_next_bar.reshape(v_bar.shape) + change_bar
        return MomentBar(x=bars["position"], v=v_bar, memory=-change_bar.reshape(-1))

"""Displacement, rotation, velocity or spin of a rigid body."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.measures.measure import AXES, BoundMeasure, Measure
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import RigidName
from cqrun.plugin.registry import plugin

UNITS = {"displacement": "m", "rotation": "rad", "velocity": "m/s", "spin": "rad/s"}


@plugin("measure", "rigid_motion")
class RigidMotion(Measure):
    """How a rigid body has moved: displacement of its centre [m] or rotation [rad], or its velocity or spin.

    Displacement and rotation are from the place of its shape, before any `offset`. A rotation in 3D is a rotation
    vector of at most a half turn.
    """

    rigid: RigidName = Field(description="Rigid body")
    of: Literal["displacement", "rotation", "velocity", "spin"] = Field(
        description="Which of its numbers", default="displacement"
    )
    relative_to: RigidName | None = Field(
        description="Another rigid body, whose displacement or velocity is subtracted: how the first one slips in it",
        default=None,
    )

    @model_validator(mode="after")
    def _subtracts_vectors(self) -> Self:
        if self.relative_to == self.rigid:
            raise complaint("RigidMotion", [finding("is the body itself: name another rigid body", ("relative_to",))])
        if self.relative_to is not None and self.of in ("rotation", "spin"):
            message = (
                "is for a displacement or a velocity: rotations of two bodies are no vectors to subtract; remove it"
            )
            raise complaint("RigidMotion", [finding(message, ("relative_to",), involves=("of",))])
        return self

    @property
    def known_late(self) -> bool:
        """It is known only when a run has ended."""
        return True

    def bind(self, matter: Matter) -> BoundMeasure:
        return BoundRigidMotion(self, matter)


class BoundRigidMotion(BoundMeasure):
    """Columns of what is seen of a rigid body."""

    def __init__(self, spec: RigidMotion, matter: Matter) -> None:
        dim, self.rigid, self.other = matter.dim, spec.rigid, spec.relative_to
        self.rows, self.unit, self.meaning = means([], matter.n_particles), UNITS[spec.of], f"{spec.of} of {spec.rigid}"
        if self.other is not None:
            self.meaning += f" relative to {self.other}"
        self.turns = spec.of == "rotation" and dim == 2
        sizes = {"displacement": dim, "rotation": 2 * dim - 3, "velocity": dim, "spin": 2 * dim - 3}
        first = sum(size for name, size in list(sizes.items())[: list(sizes).index(spec.of)])
        self.columns = slice(first, first + sizes[spec.of])
        self.components = tuple(AXES[: sizes[spec.of]]) if sizes[spec.of] > 1 else ("",)
        by_kind = {"displacement": matter.size, "rotation": np.pi, "velocity": matter.size, "spin": 2.0 * np.pi}
        self.high = np.broadcast_to(np.asarray(by_kind[spec.of], float), (len(self.components),)).copy()
        self.low = -self.high

    def values(self, track: Track) -> Array:
        values = track.rigid[self.rigid][:, self.columns]
        return np.asarray(values if self.other is None else values - track.rigid[self.other][:, self.columns])

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        rigid_bar = np.zeros(track.rigid[self.rigid].shape)
        rigid_bar[:, self.columns] = bar
        if self.other is None:
            return TrackBar(rigid={self.rigid: rigid_bar})
        return TrackBar(rigid={self.rigid: rigid_bar, self.other: -rigid_bar})

    def continuous(self, values: Array) -> Array:
        return np.unwrap(values, axis=0) if self.turns else values

"""Strain and stretch of a part of a body, from the mean deformation gradient of its particles."""

from __future__ import annotations

import numpy as np

from cqrun.errors import UsageError
from cqrun.measures.measure import AXES, BoundMeasure
from cqrun.measures.place import OnPart
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.registry import plugin


@plugin("measure", "strain")
class Strain(OnPart):
    """Green strain E = (F^T F - I) / 2 of a part, from the plain mean F of its particles' deformation gradients.

    Its components are xx, yy, (zz,) xy(, xz, yz), along the axes of the body at rest. It does not see rotations.
    """

    def bind(self, matter: Matter) -> BoundMeasure:
        return GreenStrain(self, matter)


class GreenStrain(BoundMeasure):
    """Components of E."""

    unit, meaning = "1", "Green strain"

    def __init__(self, spec: Strain, matter: Matter) -> None:
        self.rows = means([spec.members(matter)], matter.n_particles)
        i, j = np.triu_indices(matter.dim, 1)
        self.i, self.j = np.concatenate([np.arange(matter.dim), i]), np.concatenate([np.arange(matter.dim), j])
        self.components = tuple(AXES[a] + AXES[b] for a, b in zip(self.i, self.j, strict=True))
        self.high = np.ones(len(self.i))
        self.low = -self.high

    def values(self, track: Track) -> Array:
        F = track.F[:, 0]
        E = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(F.shape[1]))
        return np.asarray(E[:, self.i, self.j])

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        F = track.F[:, 0]
        E_bar = np.zeros(F.shape)
        E_bar[:, self.i, self.j] = bar
        return TrackBar(F=(0.5 * F @ (E_bar + np.swapaxes(E_bar, 1, 2)))[:, None])


@plugin("measure", "stretch")
class Stretch(OnPart):
    """Stretch of a part: |F n| along an axis n at rest, or the principal stretches of the mean deformation gradient F.

    1 is unstretched. Without `axis` the components are the principal stretches, `largest` first; where two are equal,
    the gradient is that of one order of them.
    """

    axis: list[float] | None = vector("1", "Direction at rest, scaled to length 1", default=None)

    def bind(self, matter: Matter) -> BoundMeasure:
        if self.axis is not None and not np.any(self.axis):
            raise UsageError("the axis must not be zero: give a direction, or leave it out")
        return AxisStretch(self, matter) if self.axis is not None else PrincipalStretch(self, matter)


class AxisStretch(BoundMeasure):
    """|F n| for a unit direction n; its gradient is taken as 0 where F n vanishes."""

    unit, meaning = "1", "stretch along an axis"

    def __init__(self, spec: Stretch, matter: Matter) -> None:
        self.rows = means([spec.members(matter)], matter.n_particles)
        self.axis = np.array(spec.axis) / np.linalg.norm(np.array(spec.axis))
        self.low, self.high = np.zeros(1), np.full(1, 2.0)

    def values(self, track: Track) -> Array:
        along = track.F[:, 0] @ self.axis
        return np.sqrt(np.sum(along * along, axis=1, keepdims=True))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        along, length = track.F[:, 0] @ self.axis, self.values(track)
        along_bar = bar * np.divide(along, length, out=np.zeros(along.shape), where=length > 0.0)
        return TrackBar(F=(along_bar[:, :, None] * self.axis)[:, None])


class PrincipalStretch(BoundMeasure):
    """The singular values of F, the largest first: d sigma_k = u_k . dF v_k."""

    unit, meaning = "1", "principal stretches"

    def __init__(self, spec: Stretch, matter: Matter) -> None:
        self.rows = means([spec.members(matter)], matter.n_particles)
        self.components = ("largest", "least") if matter.dim == 2 else ("largest", "middle", "least")
        self.low, self.high = np.zeros(matter.dim), np.full(matter.dim, 2.0)

    def values(self, track: Track) -> Array:
        return np.asarray(np.linalg.svd(track.F[:, 0], compute_uv=False))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        U, _, Vt = np.linalg.svd(track.F[:, 0])
        return TrackBar(F=((U * bar[:, None, :]) @ Vt)[:, None])

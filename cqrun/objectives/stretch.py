"""How far matter is stretched at most."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.contract import Array
from cqrun.geometry.region import ChosenRegion
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over, Track, TrackBar
from cqrun.observers.matter import Matter
from cqrun.observers.rows import single
from cqrun.registry import plugin


@plugin("objective", "stretch")
class Stretch(ObjectiveTerm):
    """Largest principal stretch, as a smooth maximum that is never below it: no particle is stretched more.

    s = (sum_i sum_k lambda_ik^p)^(1/p), lambda the singular values of F, over particles i of the region and principal
    directions k; and the same over the T control steps, the default of `over`. It is above the largest stretch by a
    factor of (N D T)^(1/p) at most, which it is at rest: 1.06 for a million values with the default p. A smaller p is
    smoother and further from the largest. It records every particle of the region at every control step.
    """

    least: ClassVar[float] = 0.0

    body: str = Field(description="Body that is stretched")
    region: ChosenRegion | None = Field(description="Where, at rest; the whole body if absent", default=None)
    power: int = Field(
        description="p, even: a greater one is nearer to the largest", ge=2, le=4096, multiple_of=2, default=256
    )
    over: Over | Literal["smooth_maximum"] = Field(  # type: ignore[assignment]
        description="How the values of all control steps become one; smooth_maximum is never below the greatest",
        default="smooth_maximum",
    )

    def bind(self, matter: Matter) -> BoundTerm:
        return Bound(self, matter)


class Bound(BoundTerm):
    """The p-norm: sum_k lambda_k^p = tr (F^T F)^(p/2), whose derivative by F is p F (F^T F)^(p/2 - 1)."""

    over: Over | Literal["smooth_maximum"]  # type: ignore[assignment]

    def __init__(self, spec: Stretch, matter: Matter) -> None:
        self.rows = single(matter.within(spec.body, spec.region), matter.n_particles)
        self.over, self.power = spec.over, spec.power

    def value(self, track: Track) -> float:
        """Return the values of the control steps made one."""
        return _norm(self.steps(track), self.power) if self.over == "smooth_maximum" else super().value(track)

    def value_vjp(self, track: Track, bar: float) -> TrackBar:
        """Return the cotangent of the track from that of the value."""
        if self.over != "smooth_maximum":
            return super().value_vjp(track, bar)
        h = self.steps(track)
        return self.steps_vjp(track, bar * (h / _norm(h, self.power)) ** (self.power - 1))

    def steps(self, track: Track) -> Array:
        F, size = _over_largest(track)
        total = np.trace(np.linalg.matrix_power(_square(F), self.power // 2), axis1=2, axis2=3).sum(axis=1)
        return np.asarray(size * total ** (1.0 / self.power))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        F, _ = _over_largest(track)
        below = np.linalg.matrix_power(_square(F), self.power // 2 - 1)
        total = np.trace(below @ _square(F), axis1=2, axis2=3).sum(axis=1)
        F_bar = np.zeros(track.F.shape)
        F_bar[1:] = (h_bar * total ** (1.0 / self.power - 1.0))[:, None, None, None] * (F @ below)
        return TrackBar(F=F_bar)


def _over_largest(track: Track) -> tuple[Array, Array]:
    """Return F (T, K, D, D) over its step's largest stretch (T,), so that sums of powers lie between 1 and K D."""
    F = track.F[1:]
    size = np.maximum(np.linalg.norm(F.real, 2, axis=(2, 3)).max(axis=1), np.finfo(float).tiny)
    return F / size[:, None, None, None], size


def _norm(h: Array, power: int) -> float:
    top = h.real.max()
    return top * ((h / top) ** power).sum() ** (1.0 / power)


def _square(F: Array) -> Array:
    return np.swapaxes(F, 2, 3) @ F

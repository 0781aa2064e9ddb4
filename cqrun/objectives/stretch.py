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
    """Largest principal stretch, as a power mean over particles and principal directions: 1 at rest.

    s = (sum_i sum_k lambda_ik^p / (N D))^(1/p), lambda the singular values of F: smooth everywhere, below the largest
    stretch and above it times (N D)^(-1/p). The power mean of s over the T control steps, the default of `over`, is
    smooth as well, and loses T^(-1/p) at most. It records every particle of the region at every control step.
    """

    least: ClassVar[float] = 0.0

    body: str = Field(description="Body that is stretched")
    region: ChosenRegion | None = Field(description="Where, at rest; the whole body if absent", default=None)
    power: int = Field(description="p, even: a greater one is nearer to the largest", ge=2, multiple_of=2, default=16)
    over: Over | Literal["power_mean"] = Field(  # type: ignore[assignment]
        description="How the values of all control steps become one; power_mean is a smooth maximum",
        default="power_mean",
    )

    def bind(self, matter: Matter) -> BoundTerm:
        return Bound(self, matter)


class Bound(BoundTerm):
    """The power mean: sum_k lambda_k^p = tr (F^T F)^(p/2), whose derivative by F is p F (F^T F)^(p/2 - 1)."""

    over: Over | Literal["power_mean"]  # type: ignore[assignment]

    def __init__(self, spec: Stretch, matter: Matter) -> None:
        self.rows = single(matter.within(spec.body, spec.region), matter.n_particles)
        self.over, self.power = spec.over, spec.power

    def value(self, track: Track) -> float:
        """Return the values of the control steps made one."""
        return _power_mean(self.steps(track), self.power) if self.over == "power_mean" else super().value(track)

    def value_vjp(self, track: Track, bar: float) -> TrackBar:
        """Return the cotangent of the track from that of the value."""
        if self.over != "power_mean":
            return super().value_vjp(track, bar)
        h = self.steps(track)
        return self.steps_vjp(track, bar / len(h) * (h / _power_mean(h, self.power)) ** (self.power - 1))

    def steps(self, track: Track) -> Array:
        F, size = self._scaled(track)
        total = np.trace(np.linalg.matrix_power(_square(F), self.power // 2), axis1=2, axis2=3)
        return np.asarray(size * total.mean(axis=1) ** (1.0 / self.power) / F.shape[3] ** (1.0 / self.power))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        F, _ = self._scaled(track)
        below = np.linalg.matrix_power(_square(F), self.power // 2 - 1)
        total = np.trace(below @ _square(F), axis1=2, axis2=3)
        n, dim = F.shape[1], F.shape[3]
        outer = (total.sum(axis=1) / (n * dim)) ** (1.0 / self.power - 1.0) / (n * dim)
        F_bar = np.zeros(track.F.shape)
        F_bar[1:] = (h_bar * outer)[:, None, None, None] * (F @ below)
        return TrackBar(F=F_bar)

    @staticmethod
    def _scaled(track: Track) -> tuple[Array, float]:
        """Return F (T, K, D, D) over a common size, so that no power overflows, and the size."""
        F = track.F[1:]
        size = float(np.abs(F.real).max(initial=0.0)) or 1.0
        return F / size, size


def _power_mean(h: Array, power: int) -> float:
    top = h.real.max()
    return top * ((h / top) ** power).mean() ** (1.0 / power)


def _square(F: Array) -> Array:
    return np.swapaxes(F, 2, 3) @ F

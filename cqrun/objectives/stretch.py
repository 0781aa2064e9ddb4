"""Largest stretch of a body."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.geometry.region import ChosenRegion
from cqrun.numerics.tensor import inner, mul, mul_at, plus_diagonal, scale, trace
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over, reduced_vjp
from cqrun.observers.matter import Matter
from cqrun.observers.rows import single
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName
from cqrun.plugin.registry import plugin

TINY = np.finfo(float).tiny

AT_A_TIME = 16384
"""Number of particles times control steps that are processed together."""


@plugin("objective", "stretch")
class Stretch(ObjectiveTerm):
    """Largest principal stretch, as a smooth maximum that is never below it: no particle is stretched more.

    s = (sum_i sum_k lambda_ik^p)^(1/p) with the singular values lambda of F, over particles i of the region and
    principal directions k. By default the sum is also over the T control steps. s is above the largest stretch by a
    factor of at most (N D T)^(1/p), which it reaches at rest: 1.06 for a million values with the default p. A smaller p
    is smoother and further above the largest stretch. It records every particle of the region at every control step.
    """

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body that is stretched")
    region: ChosenRegion | None = Field(description="Region, at rest; the whole body if absent", default=None)
    power: int = Field(
        description="p, even: a larger p is closer to the largest stretch",
        ge=2,
        le=4096,
        multiple_of=2,
        default=256,
    )
    over: Over | Literal["smooth_maximum"] = Field(  # type: ignore[assignment]
        description="How the values of all control steps are combined; smooth_maximum is never below the largest",
        default="smooth_maximum",
    )

    def bind(self, matter: Matter) -> BoundTerm:
        return StretchNorm(self, matter)


class StretchNorm(BoundTerm):
    """The p-norm: sum_k lambda_k^p = tr A^(p/2) with A = F^T F; its derivative by F is p F A^(p/2 - 1).

    Repeated squaring gives the power of all particles together, 10 times faster than their singular values.
    """

    over: Over | Literal["smooth_maximum"]  # type: ignore[assignment]

    def __init__(self, spec: Stretch, matter: Matter) -> None:
        self.rows = single(matter.within(spec.body, spec.region), matter.n_particles)
        self.over, self.power = spec.over, spec.power

    def value(self, track: Track) -> float:
        """Return the combined value of the control steps."""
        return _norm(self.steps(track), self.power) if self.over == "smooth_maximum" else super().value(track)

    def value_vjp(self, track: Track, bar: float) -> TrackBar:
        """Return the cotangent of the track from that of the value."""
        powers = self._powers(track)
        h = _norms(powers)
        if self.over == "smooth_maximum":
            return _track_bar(powers, bar * (h / _norm(h, self.power)) ** (self.power - 1))
        return _track_bar(powers, reduced_vjp(h, self.over, track.control_step, bar))

    def steps(self, track: Track) -> Array:
        return _norms(self._powers(track))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        return _track_bar(self._powers(track), h_bar)

    def _powers(self, track: Track) -> list[Powers]:
        """Return the powers of control steps 1 .. T, some steps at a time, so that they stay in the CPU's cache."""
        steps = max(1, AT_A_TIME // track.F.shape[1])
        return [Powers(track.F[k : k + steps], self.power) for k in range(1, len(track.F), steps)]


class Powers:
    """The p-norm of the stretches at some control steps, with what its derivative needs.

    Args:
        F: (T, K, D, D).
        power: p, even.

    Attributes:
        norm: (T,) p-norm of all principal stretches at each step.
    """

    def __init__(self, F: Array, power: int) -> None:
        self.dim = dim = F.shape[-1]
        size = np.maximum(np.abs(F.real).max(axis=(1, 2, 3)), TINY)  # divided by it, no power overflows
        self.F = tuple(F[..., i, j] / size[:, None] for i in range(dim) for j in range(dim))
        A = mul_at(self.F, self.F)
        self.below, log = _power(A, power // 2 - 1)
        self.total = inner(self.below, A).sum(axis=1)
        self.scaled = np.exp(log / power) * self.total ** (1.0 / power)
        self.norm = size * self.scaled

    def slope(self, h_bar: Array) -> Array:
        """Return the cotangent of F (T, K, D, D) from that of the norm (T,)."""
        entries = scale(mul(self.F, self.below), (h_bar * self.scaled / self.total)[:, None])
        return np.stack(entries, axis=-1).reshape(*entries[0].shape, self.dim, self.dim)


def _norms(powers: list[Powers]) -> Array:
    return np.concatenate([part.norm for part in powers])


def _track_bar(powers: list[Powers], h_bar: Array) -> TrackBar:
    bars = np.split(h_bar, np.cumsum([len(part.norm) for part in powers])[:-1])
    slopes = [part.slope(bar) for part, bar in zip(powers, bars, strict=True)]
    return TrackBar(F=np.concatenate([np.zeros_like(slopes[0][:1]), *slopes]))  # step 0 has no weight


def _power(A: Any, n: int) -> tuple[Any, Array]:
    """Return B and log c (T,) with A^n = c B, for tuples of entries (T, K); the largest trace of B in a step is 1."""
    if n > 1:
        half, log = _power(A, n // 2)
        B, log = mul(half, half), 2.0 * log
        B = mul(B, A) if n % 2 else B
    else:
        B, log = A if n else plus_diagonal(scale(A, 0.0), 1.0), np.zeros(len(A[0]))
    top = np.maximum(trace(B).real.max(axis=1), TINY)
    return scale(B, 1.0 / top[:, None]), log + np.log(top)


def _norm(h: Array, power: int) -> float:
    top = h.real.max()
    return top * ((h / top) ** power).sum() ** (1.0 / power)

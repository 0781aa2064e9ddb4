"""The branches of a Prony series: what they are, how they follow a strain, and how certain they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cqrun.fitting.identifiability import Unknown
from cqrun.fitting.uncertainty import Series, intervals
from cqrun.plugin.contract import Array

Interval = tuple[float, float]

STEP = 1e-5
"""Step of the central differences by the logarithms of the numbers."""

WIDE = 1e6
"""A number may be so many times larger or smaller."""


@dataclass(frozen=True)
class Prony:
    """Branches of a Prony series.

    Attributes:
        moduli: (b,) relative to the long-term modulus.
        times: (b,) [s], the shortest first.
        intervals: 95 % interval of each number by its name in a scene, `ratio_1`, `time_1`, ..., or None.
    """

    moduli: Array
    times: Array
    intervals: Mapping[str, Interval | None] = field(default_factory=dict)

    def stiffening(self, duration: float) -> float:
        """Return the mean modulus of a pull at a constant rate over a duration [s], relative to the long-term one."""
        x = duration / self.times
        return 1.0 + float(self.moduli @ (-np.expm1(-x) / x))

    def sentence(self) -> str:
        """Return the branches as text, with their intervals."""
        parts = []
        for k, (modulus, time) in enumerate(zip(self.moduli, self.times, strict=True), start=1):
            parts.append(f"{self._shown(f'ratio_{k}', modulus)} at {self._shown(f'time_{k}', time)} s")
        return ", ".join(parts)

    def _shown(self, name: str, value: float) -> str:
        interval = self.intervals.get(name)
        return f"{value:.3g}" + ("" if interval is None else f" ({interval[0]:.3g} to {interval[1]:.3g})")

    def fragment(self) -> dict[str, Any]:
        """Return the term of a scene's material."""
        fields: dict[str, float] = {}
        for k, (modulus, time) in enumerate(zip(self.moduli, self.times, strict=True), start=1):
            fields |= {f"ratio_{k}": float(f"{modulus:.6g}"), f"time_{k}": float(f"{time:.6g}")}
        return {"prony": fields}


def branch(time: Array, strain: Array, relaxation: float) -> Array:
    """Return the stress (n,) of a branch of modulus 1 with a relaxation time.

    It is exact for strain that is linear between points. A strain that is not zero at the first point has jumped there.
    """
    out = np.empty(len(time))
    out[0] = strain[0]
    steps, rises = np.diff(time) / relaxation, np.diff(strain)
    keep = np.exp(-steps)
    added = rises * -np.expm1(-steps) / steps
    for k in range(len(steps)):
        out[k + 1] = keep[k] * out[k] + added[k]
    return out


def with_intervals(
    prony: Prony, time: Array, strain: Array, residuals: Array, long_term: float, ends: tuple[float, float]
) -> Prony:
    """Return branches with the intervals that decision 007 gives their moduli and times.

    Args:
        time, strain: of the test (n,), the strain relative to the held one.
        residuals: (n,) the fitted stress minus the measured one, relative to the largest stress.
        long_term: the stress that is left in the end, relative to the largest one.
        ends: the times between which those of branches were sought [s]; one at an end has no interval.
    """
    count = len(prony.times)
    names = ["long_term", *(f"{what}_{k + 1}" for what in ("ratio", "time") for k in range(count))]
    values = np.concatenate([[long_term], prony.moduli, prony.times])

    def stress(logs: Array) -> Array:
        level, moduli, times = np.split(np.exp(logs), [1, 1 + count])
        return np.asarray(
            level * (strain + sum(g * branch(time, strain, t) for g, t in zip(moduli, times, strict=True)))
        )

    logs, steps = np.log(values), STEP * np.eye(len(values))
    jacobian = np.stack([(stress(logs + step) - stress(logs - step)) / (2.0 * STEP) for step in steps], axis=1)
    unknowns = [
        Unknown(name, value, low, high, log=True)
        for name, value in zip(names, values.tolist(), strict=True)
        for low, high in [ends if name.startswith("time") else (value / WIDE, value * WIDE)]
    ]
    series = [Series(np.arange(len(time)), np.arange(len(time)), 0)]
    found = intervals(jacobian, residuals, series, unknowns).intervals
    return replace(prony, intervals={name: interval for name, interval in found.items() if name != names[0]})

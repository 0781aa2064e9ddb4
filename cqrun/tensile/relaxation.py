"""Relaxation tests: the branches of a Prony series from a stress that falls while the strain is held.

The stress is P(t) = P_inf (s(t) + sum_i g_i h_i(t)) with the strain s relative to the held one. Each branch follows it:

    h_i' = s' - h_i / t_i

So g_i are moduli relative to the long-term one, the instantaneous modulus is the long-term one times 1 + sum g_i, and
what relaxes during the ramp counts. P_inf and P_inf g_i are found by nonnegative least squares on a grid of times; the
times that carry something are merged to branches and refined. The number of branches is chosen by AICc.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cqrun.errors import DataError
from cqrun.plugin.contract import Array
from cqrun.tensile.branches import Prony, branch, with_intervals
from cqrun.tensile.cleaning import without_gaps
from cqrun.tensile.curve import Curve

FEWEST = 8
"""A relaxation test has so many points."""

MOST_BRANCHES = 5
PER_DECADE = 6
"""Times of the grid in a decade."""

HELD, HOLDS = 0.02, 0.5
"""The strain is held where it differs by less than the first part from where it stays longest, for most of the time."""

FALLS = 0.01
"""A stress that falls by less than this part while the strain is held shows no relaxation."""

SAMPLES = 3.0
"""A relaxation time has to be longer than so many intervals between two points."""

EXACT = 1e-4
"""Errors below this part of the largest stress are as good as none: the ramp is known at its samples alone."""

BETTER = 10.0
"""A branch has to lower the criterion by so much: errors are not quite independent."""


@dataclass(frozen=True)
class Relaxation:
    """A fitted relaxation test.

    Attributes:
        curve: the test, with its times from 0.
        strain: that is held; None if the file does not say it.
        held_from: when the strain is held [s].
        prony: the branches.
        stress: (n,) of the fit [Pa].
        long_term: stress that is left in the end [Pa].
        findings: sentences on times that the test cannot tell.
    """

    curve: Curve
    strain: float | None
    held_from: float
    prony: Prony
    stress: Array
    long_term: float
    findings: tuple[str, ...]

    @property
    def rms(self) -> float:
        """The root mean square error, relative to the largest stress."""
        return float(np.sqrt(np.mean((self.stress - self.curve.stress) ** 2))) / self.curve.largest_stress

    def sentences(self) -> list[str]:
        """Return the branches and what is known of them, a line each."""
        g = float(self.prony.moduli.sum())
        size = "of unknown size" if self.strain is None else f"{self.strain:.3g}"
        return [
            f"Relaxation: {self.curve.source}, {len(self.curve.stress)} points over {np.ptp(self._time):.4g} s, strain "
            f"{size} held from {self.held_from:.3g} s; error {self.rms:.2%}",
            f"Branches (modulus relative to the long-term one, 95 % intervals): {self.prony.sentence()}; instantaneous "
            f"modulus = {1 + g:.4g} times the long-term one",
            *self.findings,
        ]

    @property
    def _time(self) -> Array:
        assert self.curve.time is not None
        return self.curve.time


def is_relaxation(curve: Curve) -> bool:
    """Return whether the strain of a test is held for most of its time while the stress falls."""
    if curve.time is None:
        return False
    if not np.isfinite(curve.stretch).any():
        return bool(np.sum(np.isfinite(curve.time) & np.isfinite(curve.stress)) >= FEWEST)  # time and force alone
    curve = curve.at(_seen(curve))
    time = np.asarray(curve.time)
    if len(time) < FEWEST or np.any(np.diff(time) < 0.0):
        return False
    held = _held(curve)
    stress = np.abs(curve.stress[held])
    fallen = 1.0 - stress[-1] / max(float(stress.max()), 1e-300)
    return bool(np.ptp(time[held]) > HOLDS * np.ptp(time) and (fallen > FALLS or held.start == 0))


def _seen(curve: Curve) -> Array:
    """Return which points (n,) of a test with times have all their numbers."""
    return np.isfinite(curve.stretch) & np.isfinite(curve.stress) & np.isfinite(np.asarray(curve.time))


def _held(curve: Curve) -> slice:
    """Return the points at which the strain is held: after the ramp, and before the specimen is let go."""
    strain, level = curve.stretch - 1.0, _level(curve)
    near = np.abs(strain - level) <= HELD * abs(level)
    end = int(np.flatnonzero(near)[-1]) + 1
    away = np.flatnonzero(~near[:end])
    return slice(int(away[-1]) + 1 if away.size else 0, end)


def _level(curve: Curve) -> float:
    """Return the strain at which the specimen stays longest, among the large ones."""
    strain, lasts = curve.stretch - 1.0, np.gradient(np.asarray(curve.time))
    largest = float(np.abs(strain).max())
    high = np.abs(strain) >= 0.5 * largest
    bins = np.round(strain / (HELD * largest or 1.0))
    there, place = np.unique(bins[high], return_inverse=True)
    longest = there[np.argmax(np.bincount(place, lasts[high]))]
    near = np.flatnonzero(np.abs(bins - longest) <= 1.0)
    near = near[np.argsort(strain[near])]
    passed = np.cumsum(lasts[near])
    return float(strain[near][np.searchsorted(passed, 0.5 * passed[-1])])


def fit_relaxation(curve: Curve) -> Relaxation:
    """Return the branches that fit a relaxation test.

    Raises:
        DataError: the stress does not fall, or there are too few points.
    """
    known = bool(np.isfinite(curve.stretch).any())
    curve = _whole(curve)
    level = _level(curve)
    if level == 0.0:
        raise DataError(f"{curve.source}: the strain is zero at all points: is it the right column? --column strain=N")
    held = _held(curve)
    curve = _until_let_go(curve, held)
    start, time = held.start, np.asarray(curve.time)
    fallen = 1.0 - curve.stress[-1] / curve.stress[start:].max()
    if fallen < FALLS:
        raise DataError(
            f"{curve.source}: the stress falls by {fallen:.1%} while the strain is held: no relaxation can be told; "
            "hold it longer, or start the recording before the strain is reached"
        )
    interval, length = float(np.median(np.diff(time[start:]))), float(time[-1] - time[start])
    shortest = SAMPLES * float(min(interval, np.diff(time[start:])[:5].mean()))
    grid = np.geomspace(shortest, length, max(8, int(PER_DECADE * np.log10(max(length / shortest, 10.0)))))
    strain, scale = (curve.stretch - 1.0) / level, curve.largest_stress
    stress, prony, long_term = _branches(curve, strain, grid)
    ends = _ends(grid)
    prony = with_intervals(prony, time, strain, (stress - curve.stress) / scale, long_term / scale, ends)
    findings = _findings(prony.times, shortest, length, known)
    return Relaxation(curve, level if known else None, float(time[start]), prony, stress, long_term, tuple(findings))


def _whole(curve: Curve) -> Curve:
    """Return a curve without gaps, in tension, from time 0 on; a missing strain is one that jumps at the start."""
    if curve.time is None:
        raise DataError(f"{curve.source}: a relaxation test needs times: say which column has them, as --column time=1")
    if not np.isfinite(curve.stretch).any():
        peak = int(np.nanargmax(np.abs(curve.stress)))
        what = [f"{peak} points before the largest force are not used"] if peak else []
        curve = replace(curve, stretch=np.full(len(curve.stress), 1.1)).at(slice(peak, None), *what)
    curve = without_gaps(curve, _seen(curve))
    time: Array = curve.time if curve.time is not None else np.zeros(0)
    if len(curve.stress) < FEWEST or np.any(time[1:] <= time[:-1]):
        raise DataError(f"{curve.source}: a relaxation test needs eight points or more, at times that grow")
    sign = 1.0 if np.median(curve.stress) >= 0.0 else -1.0
    return replace(curve, stress=sign * curve.stress, time=time - time[0])


def _until_let_go(curve: Curve, held: slice) -> Curve:
    """Return the curve up to where its strain is not held any more."""
    after = len(curve.stress) - held.stop
    if not after:
        return curve
    return curve.at(
        slice(0, held.stop),
        f"{after} points after the hold removed: from line {curve.line[held.stop]} on the strain is not held any more",
    )


def _branches(curve: Curve, strain: Array, grid: Array) -> tuple[Array, Prony, float]:
    """Return the fitted stress, the branches, and the stress that is left, with the best number of branches."""
    from scipy.optimize import nnls

    assert curve.time is not None
    scale = curve.largest_stress
    shapes = np.array([strain, *(branch(curve.time, strain, t) for t in grid)]).T
    weights = nnls(shapes, curve.stress / scale)[0][1:]
    best: tuple[float, tuple[Array, Prony, float]] | None = None
    for count in range(1, MOST_BRANCHES + 1):
        times = _merged(grid, weights, count)
        if len(times) < count:
            break
        times, parts, stress = _refined(curve, strain, times, grid)
        n, k = len(stress), 2 * count + 2
        error = max(float(np.mean((stress - curve.stress / scale) ** 2)), EXACT**2)
        criterion = n * np.log(error) + 2 * k + 2 * k * (k + 1) / max(n - k - 1, 1)
        if parts[0] <= 0.0 or (best is not None and criterion > best[0] - BETTER):
            continue
        kept = parts[1:] > 1e-6 * parts[0]
        prony = Prony(parts[1:][kept] / parts[0], times[kept])
        best = (criterion, (stress * scale, prony, float(parts[0] * scale)))
    if best is None:
        raise DataError(f"{curve.source}: no stress is left at the end of the test: it is too short to tell what stays")
    return best[1]


def _merged(grid: Array, weights: Array, count: int) -> Array:
    """Return so many times: the grid's weights in groups of equal weight, each at its mean logarithm."""
    total = weights.sum()
    if total <= 0.0:
        return np.zeros(0)
    carrying = np.flatnonzero(weights > 1e-4 * total)
    if len(carrying) <= count:
        times = grid[carrying]
        return times if len(times) == count else np.geomspace(grid[0], grid[-1], count + 2)[1:-1]
    middle = (np.cumsum(weights) - 0.5 * weights) / total
    group = np.minimum((middle * count).astype(int), count - 1)
    found = []
    for k in range(count):
        own = (group == k) & (weights > 0.0)
        if own.any():
            found.append(np.exp(np.average(np.log(grid[own]), weights=weights[own])))
    return np.array(found) if len(found) == count else np.geomspace(grid[0], grid[-1], count + 2)[1:-1]


def _ends(grid: Array) -> tuple[float, float]:
    """Return the times between which those of branches are sought [s]."""
    return float(grid[0]) * np.exp(-0.5), float(grid[-1]) * np.exp(1.0)


def _refined(curve: Curve, strain: Array, times: Array, grid: Array) -> tuple[Array, Array, Array]:
    """Return times, the parts of the stress (long-term first) and the stress, relative to the largest one."""
    from scipy.optimize import least_squares, nnls

    assert curve.time is not None
    time, measured = curve.time, curve.stress / curve.largest_stress

    def parts_of(logs: Array) -> tuple[Array, Array]:
        shapes = np.array([strain, *(branch(time, strain, t) for t in np.exp(logs))]).T
        parts = nnls(shapes, measured)[0]
        return parts, shapes @ parts

    low, high = np.log(_ends(grid))
    end = least_squares(
        lambda logs: parts_of(logs)[1] - measured, np.clip(np.log(times), low + 0.01, high - 0.01),
        bounds=(np.full(len(times), low), np.full(len(times), high)), ftol=1e-12, xtol=1e-10,
    )  # fmt: skip
    logs = np.sort(end.x)
    parts, stress = parts_of(logs)
    return np.exp(logs), parts, stress


def _findings(times: Array, shortest: float, length: float, known: bool) -> list[str]:
    found = []
    if not known:
        found.append(
            "the file has no strain, so the strain counts as reached at once, at the largest force: what relaxes while "
            "the specimen is pulled is missing in the branches, and the instantaneous modulus is too small; record the "
            "strain or the extension, too"
        )
    if np.any(times < 1.05 * shortest):
        found.append(
            f"a branch is faster than the test can tell ({shortest:.2g} s, three intervals between points): what "
            "relaxes faster is not in the branches; sample faster at the start"
        )
    if np.any(times > 0.5 * length):
        found.append(
            f"a branch of {times.max():.3g} s is not over at the end of the test ({length:.3g} s): its time and the "
            "long-term modulus are uncertain; hold the strain longer"
        )
    return found


def choose_relaxation(curves: Sequence[Curve], wanted: bool | None) -> tuple[list[Curve], list[Curve]]:
    """Return the relaxation tests among curves, and the others; `wanted` says what all are, if it is not None."""
    held = [is_relaxation(curve) if wanted is None else wanted for curve in curves]
    pairs = list(zip(curves, held, strict=True))
    return [curve for curve, it_is in pairs if it_is], [curve for curve, it_is in pairs if not it_is]

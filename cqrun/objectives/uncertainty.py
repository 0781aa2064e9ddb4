"""How sure a fit is: 95 % intervals from the residuals' Jacobian at the optimum.

Errors of one marker's coordinate follow each other in time. Their variance therefore counts times the
integrated autocorrelation time, which thins n residuals to n / tau independent ones:

    covariance = A (sum over series of sigma_s^2 tau_s J_s^T J_s) A,   A = (J^T J)^-1,

with sigma_s^2 the series' own residual variance, less what the unknowns fitted of it. Coordinates of markers on one
body err together, too: where two series of a recording are correlated by rho_st, beyond chance, the sum has

    rho_st sigma_s sigma_t sqrt(tau_s tau_t) (J_s^T J_t + J_t^T J_s)

as well; an interval is widened where this makes its variance larger, and never narrowed. Intervals are Student's, taken
in the logarithm of log-scaled unknowns, with (sum of n_s / tau_s) - p degrees of freedom; S series of a recording
that err together count as S^2 / sum rho_st^2 of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.contract import Array
from cqrun.objectives.identifiability import Directions, Unknown, find_directions

MOST_UNKNOWNS = 30
"""With more unknowns no intervals are computed: the Jacobian takes two rollouts an unknown."""

STEP = 1e-3
"""Difference step: of the logarithm, or of the width of the bounds for unknowns on a linear scale."""

_AT_BOUND = 1e-4
_LARGEST_POWER = 500.0
_SHORTEST = 8
_CHANCE = 2.0
"""A correlation of independent series is less than this over the square root of their length, 95 times in 100."""


@dataclass(frozen=True)
class Series:
    """One coordinate of one marker among the residuals.

    Attributes:
        where: (n,) its places, in order of time.
        frames: (n,) the recording's frames they are of.
        recording: which one.
    """

    where: Array
    frames: Array
    recording: int


@dataclass(frozen=True)
class Uncertainty:
    """What the data leave open.

    Attributes:
        intervals: 95 % interval by unknown, in its own unit; None where there is none.
        reasons: why there is none, for those unknowns.
        findings: sentences on unknowns that the data do not tell, or not apart.
        covariance: (p, p) in working coordinates (log of log-scaled unknowns); NaN without an interval.
        degrees: of freedom of Student's distribution.
    """

    intervals: dict[str, tuple[float, float] | None]
    reasons: dict[str, str]
    findings: tuple[str, ...]
    covariance: Array
    degrees: float


def central_jacobian(evaluate: Callable[[list[Array]], list[Array]], unknowns: Sequence[Unknown]) -> Array:
    """Return dr/dz (n, p) by central differences; columns of unknowns at a bound stay nought, and with no other n is 0.

    Args:
        evaluate: residuals (n,) at each of a list of points (p,) of the unknowns' values, which may be
            computed side by side.
        unknowns: p of them, at the optimum; z is the logarithm of log-scaled ones.
    """
    z = np.array([u.coordinate for u in unknowns])
    free = [i for i, u in enumerate(unknowns) if bound_reached(u) is None]
    steps = {i: _step(unknowns[i]) for i in free}
    points = [z + sign * steps[i] * np.eye(len(z))[i] for i in free for sign in (1.0, -1.0)]
    values = [np.array([u.from_coordinate(c) for u, c in zip(unknowns, point, strict=True)]) for point in points]
    found = evaluate(values)
    if not found:
        return np.zeros((0, len(z)))
    jacobian = np.zeros((len(found[0]), len(z)))
    for column, i in enumerate(free):
        jacobian[:, i] = (found[2 * column] - found[2 * column + 1]) / (2 * steps[i])
    return jacobian


def intervals(
    jacobian: Array,
    residuals: Array,
    series: Sequence[Series],
    unknowns: Sequence[Unknown],
    confidence: float = 0.95,
) -> Uncertainty:
    """Return the intervals of unknowns at the optimum, or why there are none.

    Args:
        jacobian: (n, p) dr/dz, as `central_jacobian` gives it.
        residuals: (n,) at the optimum, scaled as in the loss.
        series: the time series among the residuals.
        unknowns: p of them, at the optimum.
    """
    p = len(unknowns)
    reasons = {u.name: f"at its {end} bound" for u in unknowns if (end := bound_reached(u))}
    if p > MOST_UNKNOWNS:
        return _nothing(unknowns, f"more than {MOST_UNKNOWNS} unknowns")
    free = [i for i, u in enumerate(unknowns) if u.name not in reasons]
    if not free:
        names = [u.name for u in unknowns]
        return Uncertainty(dict.fromkeys(names), reasons, (), np.full((p, p), np.nan), 0.0)
    if len(residuals) <= len(free):
        return _nothing(unknowns, "no more residuals than unknowns")
    directions = find_directions(jacobian[:, free], [unknowns[i] for i in free])
    reasons |= directions.reasons
    part, degrees = _sandwich(jacobian[:, free], residuals, series, directions)
    covariance = np.full((p, p), np.nan)
    told = np.array([unknowns[i].name not in reasons for i in free], dtype=bool)
    place = np.array(free, dtype=int)[told]
    covariance[np.ix_(place, place)] = part[np.ix_(told, told)]
    found = {u.name: None for u in unknowns} | {
        unknowns[i].name: _interval(unknowns[i], covariance[i, i], degrees, confidence) for i in place
    }
    reasons |= {
        name: "the data leave it open by hundreds of powers of ten"
        for name, interval in found.items()
        if interval is None and name not in reasons
    }
    wide = [_wide(u, interval) for u in unknowns if (interval := found[u.name]) is not None]
    findings = (*directions.findings, *filter(None, wide))
    return Uncertainty(found, reasons, findings, covariance, degrees)


def student(degrees: float, confidence: float) -> float:
    """Return how many standard errors an interval of Student's distribution reaches to either side."""
    from scipy.special import stdtrit

    return float(stdtrit(degrees, 0.5 + 0.5 * confidence))


def interval_of_mean(values: Array, confidence: float) -> tuple[Array, Array]:
    """Return the mean over the first axis of independent values (n, ...), n at least 2, and half its interval."""
    n = len(values)
    return values.mean(axis=0), student(n - 1, confidence) * values.std(axis=0, ddof=1) / np.sqrt(n)


def autocorrelation_time(series: Array) -> float:
    """Return the integrated autocorrelation time of residuals about nought, in samples, at least 1.

    The larger of two estimates. Geyer's initial positive sequence, sums of two neighbouring
    autocorrelations up to the first that is not positive, follows any correlation but falls short in
    short series; that of a first-order autoregression is corrected for it (Marriott and Pope 1954).
    """
    n = len(series)
    power = float(series @ series) / n
    if power == 0.0 or n < _SHORTEST:
        return 1.0
    scaled = series / np.sqrt(power)

    def correlation(lag: int) -> float:
        return float(scaled[: n - lag] @ scaled[lag:])

    geyer, last = -1.0, np.inf
    for lag in range(0, n // 2, 2):
        pair = correlation(lag) / (n - lag) + correlation(lag + 1) / (n - lag - 1)
        last = min(pair, last)
        if last <= 0:
            break
        geyer += 2.0 * last
    first = correlation(1) / n
    corrected = min(first + (1.0 + 3.0 * first) / n, 1.0 - 4.0 / n) if first > 0 else 0.0
    return min(max(1.0, geyer, (1.0 + corrected) / (1.0 - corrected)), n / 2)


def bound_reached(unknown: Unknown) -> str | None:
    """Return `lower` or `upper` if the optimum sits on that bound."""
    low, here, high = unknown.ends[0], unknown.coordinate, unknown.ends[1]
    slack = _AT_BOUND * (high - low)
    return "lower" if here - low <= slack else "upper" if high - here <= slack else None


def _step(unknown: Unknown) -> float:
    low, high = unknown.ends
    step = STEP * (1.0 if unknown.log else high - low)
    return min(step, unknown.coordinate - low, high - unknown.coordinate)


def _sandwich(J: Array, r: Array, series: Sequence[Series], directions: Directions) -> tuple[Array, float]:
    """Return the covariance of all unknowns in J, and the degrees of freedom."""
    inverse = directions.inverse
    apart, together, samples = np.zeros_like(inverse), np.zeros_like(inverse), 0.0
    tau = [autocorrelation_time(r[s.where]) for s in series]
    sigma = [_deviation(J[s.where], r[s.where], t, inverse) for s, t in zip(series, tau, strict=True)]
    for recording in dict.fromkeys(s.recording for s in series):
        own = [k for k, s in enumerate(series) if s.recording == recording]
        for k in own:
            apart += sigma[k] ** 2 * tau[k] * J[series[k].where].T @ J[series[k].where]
        times, sizes = np.array([tau[k] for k in own]), np.array([sigma[k] for k in own])
        shared, squares = _shared(J, r, [series[k] for k in own], times, sizes)
        together += shared
        independent = sum(len(series[k].where) / tau[k] for k in own)
        samples += independent * len(own) / squares
    covariance, more = inverse @ apart @ inverse, inverse @ together @ inverse
    variance = np.maximum(np.diag(covariance), np.finfo(float).tiny)
    widened = np.sqrt(np.maximum(1.0, 1.0 + np.diag(more) / variance))
    return covariance * np.outer(widened, widened), max(1.0, samples - directions.rank)


def _deviation(J: Array, errors: Array, tau: float, inverse: Array) -> float:
    """Return the standard deviation of one series, without what the unknowns fitted of it."""
    fitted = float(np.sum(inverse * (J.T @ J)))  # trace: how many unknowns this series decides
    return float(np.sqrt(errors @ errors / max(len(errors) - tau * fitted, 0.2 * len(errors))))


def _shared(J: Array, r: Array, own: Sequence[Series], tau: Array, sigma: Array) -> tuple[Array, float]:
    """Return what errors that series of a recording share add to the covariance of J^T r, and the sum of rho^2.

    rho is the correlation of two series over the frames that both have, nought where chance alone gives as much; the
    sum is over all pairs, each series with itself among them. On the frames of all, a series is 0 where it has none.
    """
    frames = np.unique(np.concatenate([s.frames for s in own]))
    errors, seen = np.zeros((2, len(own), len(frames)))
    slopes = np.zeros((*errors.shape, J.shape[1]))
    for k, s in enumerate(own):
        at = np.searchsorted(frames, s.frames)
        errors[k, at], seen[k, at], slopes[k, at] = r[s.where], 1.0, J[s.where]
    power, common, time = errors**2 @ seen.T, seen @ seen.T, np.sqrt(np.outer(tau, tau))
    power = np.sqrt(power * power.T)
    rho = np.divide(errors @ errors.T, power, out=np.zeros_like(power), where=power > 0.0)
    rho[(common < _SHORTEST) | (np.abs(rho) * np.sqrt(common / time) <= _CHANCE)] = 0.0
    np.fill_diagonal(rho, 0.0)
    weighted = np.tensordot(rho * np.outer(sigma, sigma) * time, slopes, axes=1)
    return np.tensordot(slopes, weighted, axes=([0, 1], [0, 1])), len(own) + float(np.sum(rho**2))


def _interval(u: Unknown, variance: float, degrees: float, confidence: float) -> tuple[float, float] | None:
    half = student(degrees, confidence) * float(np.sqrt(variance))
    if u.log and half > _LARGEST_POWER:
        return None
    return u.from_coordinate(u.coordinate - half), u.from_coordinate(u.coordinate + half)


def _wide(unknown: Unknown, interval: tuple[float, float]) -> str | None:
    """Return a sentence if the data say no more than the bounds did."""
    low, high = (unknown.to_coordinate(x) for x in interval)
    if high - low < unknown.ends[1] - unknown.ends[0]:
        return None
    return f"{unknown.name}: its interval is wider than its bounds; the data hardly tell it"


def _nothing(unknowns: Sequence[Unknown], reason: str) -> Uncertainty:
    names, p = [u.name for u in unknowns], len(unknowns)
    return Uncertainty(dict.fromkeys(names), dict.fromkeys(names, reason), (), np.full((p, p), np.nan), 0.0)

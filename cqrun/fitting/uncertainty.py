"""Uncertainty of a fit: 95 % intervals from the Jacobian of the residuals at the optimum.

Errors e move a least-squares fit by A J^T e with A = (J^T J)^-1: unknown i by sum_t a(t) e(t) with a = J A_i. Errors of
a series are correlated in time, with correlations R. So the series adds to the variance

    sigma^2 a^T R a = sigma^2 tau |a|^2.

sigma^2 is the residual variance of the series, corrected for the part that the unknowns fitted (Newey and West 1987;
lags as in Geyer's initial sequence, 1992). If a is constant, tau is the integrated autocorrelation time, at most n: a
constant error counts once.

Markers of a recording may share errors. So the variance is computed twice, and the wider interval is used. The first
sums over series as if their errors were independent. The second sums over components of all series: by singular values
a_s(t) = sum_k u_ks c_k v_k(t); component k has c_k v_k as its a and sum_s u_ks e_s(t) as its errors. The u have length
1, so both agree for independent errors of equal size. Six markers with identical errors count as one (Driscoll and
Kraay 1998).

Displacements are measured from a mean over still frames; its error shifts a whole series. It adds
var(mean) (sum_t a(t))^2, where the scatter of the still frames gives var(mean), again independent or shared.

Intervals are Student's, in the logarithm for log-scaled unknowns, with Satterthwaite's degrees of freedom (1946). If
errors stay correlated for much longer than the recording, intervals are too narrow, and no residual shows it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from cqrun.fitting.identifiability import Unknown, find_directions
from cqrun.plugin.contract import Array

MOST_UNKNOWNS = 30
"""With more unknowns no intervals are computed: the Jacobian takes two rollouts per unknown."""

STEP = 1e-3
"""Difference step, in the logarithm or as a part of the range of the bounds on a linear scale."""

AT_BOUND = 1e-4
"""An unknown closer to its bound than this part of the distance between the bounds is at the bound."""

_LARGEST_POWER = 500.0
_SHORTEST = 8
_BLOCKS = 12
"""Number of blocks in a window of correlated errors; the correlation is taken from their means."""

_LEAST_SHARE = 0.2
"""Smallest share of a variance that is assumed to remain in residuals: the unknowns can fit slow errors."""

_NEGLIGIBLE = 1e-4
"""Components with less than this part of the first one's variance are ignored."""


@dataclass(frozen=True)
class Series:
    """One coordinate of one marker among the residuals.

    Attributes:
        where: (n,) its indices among the residuals, in order of time.
        frames: (n,) their frames in the recording.
        recording: number of the recording.
        still: (m,) values of the still frames minus their mean, scaled like the residuals; NaN if not visible. Empty if
            the series is not measured from a mean.
    """

    where: Array
    frames: Array
    recording: int
    still: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty of the unknowns.

    Attributes:
        intervals: 95 % interval by unknown, in its own unit, or None.
        reasons: by unknown, why there is no interval.
        findings: sentences on unknowns that the data do not determine.
        covariance: (p, p) in working coordinates (log of log-scaled unknowns); NaN without an interval.
        degrees: (p,) of freedom of Student's distribution; NaN without an interval.
    """

    intervals: dict[str, tuple[float, float] | None]
    reasons: dict[str, str]
    findings: tuple[str, ...]
    covariance: Array
    degrees: Array


def central_jacobian(evaluate: Callable[[list[Array]], list[Array]], unknowns: Sequence[Unknown]) -> Array:
    """Return dr/dz (n, p) by central differences; columns of unknowns at a bound are zero. n is 0 if all are at one.

    Args:
        evaluate: returns the residuals (n,) at each of a list of points (p,) of the unknowns' values.
        unknowns: the p unknowns at the optimum; z is the logarithm of log-scaled ones.
    """
    z = np.array([u.coordinate for u in unknowns])
    free = [i for i, u in enumerate(unknowns) if bound_reached(u) is None]
    steps = {i: _step(unknowns[i]) for i in free}
    points = [z + sign * steps[i] * np.eye(len(z))[i] for i in free for sign in (1.0, -1.0)]
    values = [np.array([u.from_coordinate(c) for u, c in zip(unknowns, point, strict=True)]) for point in points]
    residuals = evaluate(values)
    if not residuals:
        return np.zeros((0, len(z)))
    jacobian = np.zeros((len(residuals[0]), len(z)))
    for column, i in enumerate(free):
        jacobian[:, i] = (residuals[2 * column] - residuals[2 * column + 1]) / (2 * steps[i])
    return jacobian


def intervals(
    jacobian: Array, residuals: Array, series: Sequence[Series], unknowns: Sequence[Unknown], confidence: float = 0.95
) -> Uncertainty:
    """Return the intervals of unknowns at the optimum, or why there are none.

    Args:
        jacobian: (n, p) dr/dz, from `central_jacobian`.
        residuals: (n,) at the optimum, scaled as in the loss.
        series: the time series among the residuals.
        unknowns: the p unknowns at the optimum.
    """
    p = len(unknowns)
    reasons = {u.name: f"at its {end} bound" for u in unknowns if (end := bound_reached(u))}
    if p > MOST_UNKNOWNS:
        return _nothing(unknowns, f"more than {MOST_UNKNOWNS} unknowns")
    free = [i for i, u in enumerate(unknowns) if u.name not in reasons]
    if not free:
        names = [u.name for u in unknowns]
        return Uncertainty(dict.fromkeys(names), reasons, (), np.full((p, p), np.nan), np.full(p, np.nan))
    if len(residuals) <= len(free):
        return _nothing(unknowns, "no more residuals than unknowns")
    directions = find_directions(jacobian[:, free], [unknowns[i] for i in free])
    reasons |= directions.reasons
    part, freedom = _sandwich(jacobian[:, free], residuals, series, directions.inverse, confidence)
    covariance, degrees = np.full((p, p), np.nan), np.full(p, np.nan)
    resolved = np.array([unknowns[i].name not in reasons for i in free], dtype=bool)
    place = np.array(free, dtype=int)[resolved]
    covariance[np.ix_(place, place)], degrees[place] = part[np.ix_(resolved, resolved)], freedom[resolved]
    by_name = {u.name: None for u in unknowns} | {
        unknowns[i].name: _interval(unknowns[i], covariance[i, i], degrees[i], confidence) for i in place
    }
    reasons |= {
        name: "the data do not limit it, not even to hundreds of powers of ten"
        for name, interval in by_name.items()
        if interval is None and name not in reasons
    }
    beyond = [_beyond(u, interval) for u in unknowns if (interval := by_name[u.name]) is not None]
    findings = (*directions.findings, *filter(None, beyond))
    return Uncertainty(by_name, reasons, findings, covariance, degrees)


def student(degrees: float, confidence: float) -> float:
    """Return the half-width of an interval of Student's distribution in standard errors."""
    from scipy.special import stdtrit

    return float(stdtrit(degrees, 0.5 + 0.5 * confidence))


def interval_of_mean(values: Array, confidence: float) -> tuple[Array, Array]:
    """Return the mean over the first axis of n >= 2 independent values (n, ...), and half the width of its interval."""
    n = len(values)
    return values.mean(axis=0), student(n - 1, confidence) * values.std(axis=0, ddof=1) / np.sqrt(n)


@dataclass(frozen=True)
class Memory:
    """The autocorrelation of the errors of a series.

    Attributes:
        lags: (2, n) autocorrelation by lag, in two estimates. Geyer's initial positive sequence (pairs of neighbours
            that never rise, up to the first that is not positive) fits any correlation. A first-order autoregression
            extrapolates where a short series has no more information. Both are corrected for a fitted mean (the second
            as in Marriott and Pope 1954).
        window: number of lags on both sides in the sum of the first estimate.
    """

    lags: Array
    window: float

    @property
    def time(self) -> float:
        """The integrated autocorrelation time, in samples, from 1 to n."""
        return float(np.clip(2.0 * self.lags.sum(axis=1).max() - 1.0, 1.0, self.lags.shape[1]))

    def times(self, slopes: Array) -> Array:
        """Return the factors (q,), at least 1, by which correlation increases the variance of slopes^T e.

        They are v^T R v / v^T v for the errors' correlation R and the columns v of slopes (n, q): the integrated time
        if v is constant, and less if it alternates faster than the errors.
        """
        n = len(slopes)
        waves = np.fft.rfft(slopes, 2 * n, axis=0)
        products = np.fft.irfft(np.abs(waves) ** 2, 2 * n, axis=0)[:n]
        power = np.maximum(products[0], np.finfo(float).tiny)
        return np.asarray(np.maximum(1.0, (2.0 * self.lags @ products / power).max(axis=0) - 1.0))

    def samples(self, times: Array) -> Array:
        """Return the number of independent samples in an estimate of sigma^2 times.

        A part 1 / times of it comes from single samples, the rest from n / window sums over the window's lags.
        """
        return np.asarray(self.lags.shape[1] / (times**-2.0 + (1.0 - 1.0 / times) ** 2 * max(self.time, self.window)))


def autocorrelation_time(series: Array) -> float:
    """Return the integrated autocorrelation time of residuals with mean zero, in samples, from 1 to their number."""
    return memory(series).time


def memory(errors: Array) -> Memory:
    """Return the autocorrelation of errors (n,) with mean zero; fewer than 8 count as independent."""
    n = len(errors)
    none, power = np.eye(1, max(n, 1))[0], float(errors @ errors) / max(n, 1)
    if power == 0.0 or n < _SHORTEST:
        return Memory(np.stack([none, none]), 1.0)
    sums = np.correlate(errors, errors, "full")[n - 1 :] / power
    pairs = (sums / np.arange(n, 0, -1))[: n - n % 2].reshape(-1, 2).sum(axis=1)
    pairs = np.minimum.accumulate(pairs)
    kept = int(np.argmax(np.r_[pairs, -1.0] <= 0.0))
    window = min(4.0 * kept, n)
    geyer = np.zeros(n)
    geyer[: 2 * kept] = np.repeat(0.5 * pairs[:kept], 2)
    geyer[1] = max(0.0, pairs[0] - 1.0)
    geyer = np.minimum(geyer / max(1.0 - window / n, _LEAST_SHARE), 1.0)
    geyer[0] = 1.0
    return Memory(np.stack([geyer, _autoregression(errors, max(1, int(window / _BLOCKS)))]), window)


def _autoregression(errors: Array, block: int) -> Array:
    """Return the autocorrelation by lag of a first-order autoregression with white noise, fitted to means of blocks."""
    means = errors[: len(errors) // block * block].reshape(-1, block).mean(axis=1)
    n, power = len(means), float(means @ means)
    first = float(means[:-1] @ means[1:]) / power if power > 0.0 else 0.0
    corrected = min(first + (1.0 + 3.0 * first) / n, 1.0) if first > 0.0 else 0.0
    share = min(1.0, power / n / float(errors @ errors) * len(errors))
    lags = share * corrected ** (np.arange(len(errors)) / block)
    lags[0] = 1.0
    return lags


def bound_reached(unknown: Unknown) -> str | None:
    """Return `lower` or `upper` if the optimum is at this bound."""
    low, here, high = unknown.ends[0], unknown.coordinate, unknown.ends[1]
    slack = AT_BOUND * (high - low)
    return "lower" if here - low <= slack else "upper" if high - here <= slack else None


def _step(unknown: Unknown) -> float:
    low, high = unknown.ends
    step = STEP * (1.0 if unknown.log else high - low)
    return min(step, unknown.coordinate - low, high - unknown.coordinate)


# --- the sandwich -------------------------------------------------------------------------------------------------
# A sum of variances has two rows (2, p): the variances, and their squares divided by their degrees of freedom. The sums
# of both give the degrees of freedom of the total (Satterthwaite).


def _sandwich(J: Array, r: Array, series: Sequence[Series], inverse: Array, confidence: float) -> tuple[Array, Array]:
    """Return the covariance (p, p) of all unknowns in J, and their degrees of freedom (p,)."""
    covariance, root = np.zeros_like(inverse), _root(inverse)
    apart, together = np.zeros((2, 2, len(inverse)))
    for s in series:
        for deviations, degrees in _of_series(J[s.where], r[s.where], s.still, inverse, root):
            covariance += deviations.T @ deviations
            apart += _counted((deviations**2).sum(axis=0), degrees)
    for recording in dict.fromkeys(s.recording for s in series):
        together += _of_recording(J, r, [s for s in series if s.recording == recording], inverse, root)
    sums = np.stack([apart, together])
    degrees = np.maximum(1.0, sums[:, 0] ** 2 / np.maximum(sums[:, 1], np.finfo(float).tiny))
    reach = np.sqrt(sums[:, 0]) * np.vectorize(student)(degrees, confidence)
    wider, every = np.argmax(reach, axis=0), np.arange(len(inverse))
    widened = np.sqrt(sums[wider, 0, every] / np.maximum(apart[0], np.finfo(float).tiny))
    return covariance * np.outer(widened, widened), degrees[wider, every]


def _root(A: Array) -> Array:
    values, vectors = np.linalg.eigh(A)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _counted(variance: Array | float, degrees: Array | float) -> Array:
    return np.array([variance, variance**2 / degrees])


def _long_run(errors: Array, slopes: Array, along: Array, root: Array, seen: float) -> tuple[Array, Array]:
    """Return sigma^2 tau (q,) of one series for sums of its errors along q directions, and their degrees of freedom.

    Args:
        errors: (n,), of which `seen` are not empty.
        slopes: (n, p) of the unknowns, which have fitted a part of the errors.
        along: (n, q) weights of the errors in the sums.
        root: (p, p) with A = root root^T.
    """
    correlation, fitted = memory(errors), slopes @ root
    shares = (fitted**2).sum(axis=0)  # their sum is the number of unknowns that this series determines
    free = max(seen - float(shares @ correlation.times(fitted)), _LEAST_SHARE * seen)
    tau = correlation.times(along)
    degrees = correlation.samples(tau) * seen / len(errors) - shares.sum()
    return float(errors @ errors) / free * tau, np.maximum(1.0, degrees)


def _of_mean(still: Array) -> tuple[float, float]:
    """Return the variance of the mean of two or more still values (m,), and its degrees of freedom."""
    m, ones = len(still), np.ones((len(still), 1))
    variance, degrees = _long_run(still, ones, ones, np.full((1, 1), m**-0.5), m)
    return float(variance[0]) / m, float(degrees[0])


def _of_series(J: Array, r: Array, still: Array, inverse: Array, root: Array) -> Iterator[tuple[Array, Array]]:
    """Yield deviations (k, p) of the unknowns and degrees of freedom (p,): of the frames, then of the still mean."""
    along = J @ inverse
    variance, degrees = _long_run(r, J, along, root, len(r))
    yield along * np.sqrt(variance), degrees
    seen = still[~np.isnan(still)]
    if seen.size:
        offset, free = _of_mean(seen) if seen.size > 1 else (float(r @ r) / len(r), 1.0)
        yield np.sqrt(offset) * along.sum(axis=0)[None], np.full(len(inverse), free)


def _of_recording(J: Array, r: Array, series: Sequence[Series], inverse: Array, root: Array) -> Array:
    """Return the sum of variances (2, p) of a recording whose series may share errors; missing frames count as 0."""
    frames = np.unique(np.concatenate([s.frames for s in series]))
    errors = np.zeros((len(series), len(frames)))
    slopes = np.zeros((*errors.shape, J.shape[1]))
    for k, s in enumerate(series):
        at = np.searchsorted(frames, s.frames)
        errors[k, at], slopes[k, at] = r[s.where], J[s.where]
    seen, still = np.array([len(s.frames) for s in series]), np.nan_to_num([s.still for s in series])
    total = np.zeros((2, J.shape[1]))
    for i, row in enumerate(inverse):
        U, sizes, Vt = np.linalg.svd(slopes @ row, full_matrices=False)
        for u, size, v in zip(U.T, sizes, Vt, strict=True):
            if size**2 > _NEGLIGIBLE * sizes[0] ** 2:
                variance, free = _long_run(u @ errors, np.tensordot(u, slopes, axes=1), v[:, None], root, u**2 @ seen)
                total[:, i] += _counted(size**2 * variance, free)[:, 0]
        if still.shape[1] > 1:
            total[:, i] += _counted(*_of_mean((slopes @ row).sum(axis=1) @ still))
    return total


def _interval(u: Unknown, variance: float, degrees: float, confidence: float) -> tuple[float, float] | None:
    half = student(degrees, confidence) * float(np.sqrt(variance))
    if u.log and half > _LARGEST_POWER:
        return None
    return u.from_coordinate(u.coordinate - half), u.from_coordinate(u.coordinate + half)


def _beyond(unknown: Unknown, interval: tuple[float, float]) -> str | None:
    """Return a sentence if the interval reaches past a bound, or is wider than the bounds."""
    low, high = (unknown.to_coordinate(x) for x in interval)
    if high - low >= unknown.ends[1] - unknown.ends[0]:
        return f"{unknown.name}: its interval is wider than its bounds; the data hardly determine it"
    past = [
        f"{end} bound, {bound:.4g}"
        for end, bound, out in (
            ("lower", unknown.lower, low < unknown.ends[0]),
            ("upper", unknown.upper, high > unknown.ends[1]),
        )
        if out
    ]
    if not past:
        return None
    reach = f"its interval, {interval[0]:.4g} to {interval[1]:.4g}, reaches past its {past[0]}"
    return f"{unknown.name}: {reach}: the data allow values that the bounds do not"


def _nothing(unknowns: Sequence[Unknown], reason: str) -> Uncertainty:
    names, p = [u.name for u in unknowns], len(unknowns)
    return Uncertainty(
        dict.fromkeys(names), dict.fromkeys(names, reason), (), np.full((p, p), np.nan), np.full(p, np.nan)
    )

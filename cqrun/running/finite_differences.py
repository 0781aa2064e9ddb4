"""Compare an adjoint with finite differences along one direction.

Central differences D(h) = (f(x + h d) - f(x - h d)) / 2h for a scan of steps are extrapolated to fourth order,

    E(h) = (16 D(h/4) - D(h)) / 15.

Large steps have errors from curvature, small ones from rounding; between them is a plateau. It is where E changes least
from step to step relative to its size, which does not depend on the adjoint. There the two must agree. Without a
plateau, differences are too rough to judge the adjoint.

If a branch changes between the points (contact, stick and slip), the loss has kinks. Steps that reach beyond a kink can
have a plateau of their own, between the slopes of its two sides. So the scan continues below its usual end if the two
do not agree, and a plateau counts only if the smallest steps do not contradict it. If a kink is closer than every step,
the differences to each side are two slopes, and the adjoint must agree with one of them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from cqrun.errors import RolloutError
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.running.state_loss import Loss
from cqrun.store.result import Direction, Verdict

ALL_STEPS = 1e-2 * 4.0 ** -np.arange(19)
"""Steps of the central differences in scaled coordinates, 1e-2 to 1e-13."""

STEPS = ALL_STEPS[:11]
"""The steps of every scan, down to 1e-8; smaller ones are taken only in doubt."""

TOLERANCE = {"float64": 1e-5, "float32": 5e-2}
"""Largest relative difference on the plateau."""

NOISE = 100.0
"""Noise of the loss, in rounding errors."""

ROUGH = 1e-4
"""Largest relative scatter of a plateau for which a difference within the scatter is accepted."""

MOST = 10.0
"""Largest part of the loss that can be rounding error, in roots of the precision."""

FAR = 3.0
"""A difference of more than this many times the scatter shows a wrong adjoint, even if the differences are rough."""

AGREES: Final = "agrees"
AT_A_KINK: Final = "agrees at a kink"
FLAT: Final = "flat"
TOO_ROUGH: Final = "too rough"
DISAGREES: Final = "disagrees"


class Estimate(NamedTuple):
    """A derivative from a scan of steps: its value, its uncertainty, and the index of the step."""

    value: float
    noise: float
    at: int


def check_direction(block: str, loss: Loss, value: float, gradient: Array, d: Array, precision: str) -> Direction:
    """Compare the gradient (n,) with differences along one direction d."""
    adjoint, tolerance = float(gradient @ d), TOLERANCE[precision]
    eps, large = float(np.finfo(precision).eps), float(max(abs(value), loss.scale))
    rounding = NOISE * eps * large
    around = _usual_values(loss, d, rounding)
    scan, floor, best = _central_estimate(around, rounding, MOST * eps**0.5 * large)
    verdict, at = _verdict(adjoint, best, float(floor[best.at]), tolerance), best
    if verdict in (TOO_ROUGH, DISAGREES) and np.isfinite(best.value):  # in doubt: all smaller steps, then each side
        around = np.append(around, values_around(loss, d, ALL_STEPS[around.shape[1] :]), axis=1)
        scan, floor, best = _central_estimate(around, rounding, MOST * eps**0.5 * large)
        verdict, at = _verdict(adjoint, best, float(floor[best.at]), tolerance), best
    if verdict in (TOO_ROUGH, DISAGREES):
        sides = one_sided(around[0], value), one_sided(around[1], value, -1.0)
        verdict, at = _beside_kinks(adjoint, verdict, best, sides, 2.0 * floor, tolerance)
    known = bool(np.isfinite(at.value))
    return Direction(
        block=block, count=int(np.count_nonzero(d)), adjoint=adjoint, differences=at.value if known else None,
        error=_relative(adjoint, at.value) if known else None, step=float(ALL_STEPS[at.at]), noise=at.noise,
        scan=[float(e) if np.isfinite(e) else None for e in scan], verdict=verdict,
        agrees=verdict in (AGREES, AT_A_KINK, FLAT),
    )  # fmt: skip


def _central_estimate(around: Array, rounding: float, most: float) -> tuple[Array, Array, Estimate]:
    """Return E at every step, its rounding error, and the derivative."""
    scan = central(*around)
    floor = max(rounding, rounding_alone(scan, most)) / ALL_STEPS[: len(scan)]
    return scan, floor, estimate(scan, floor)


def _beside_kinks(
    adjoint: float, verdict: Verdict, best: Estimate, sides: tuple[Array, Array], floor: Array, tolerance: float
) -> tuple[Verdict, Estimate]:
    """Return the verdict on an adjoint that central differences contradict, and what it was compared with."""
    slopes = _two_slopes(*sides, floor, best.at if best.noise <= ROUGH * abs(best.value) else 0)
    equal = [slope for pair in slopes for slope in pair if _equal(adjoint, slope, tolerance)]
    if equal:
        return AT_A_KINK, equal[-1]
    if slopes and not all(map(_is_steady, sides, slopes[0], [floor] * 2)):
        return TOO_ROUGH, best
    return verdict, best


def _verdict(adjoint: float, found: Estimate, floor: float, tolerance: float) -> Verdict:
    if not np.isfinite(found.value):
        return DISAGREES
    size, off = max(abs(adjoint), abs(found.value)), abs(adjoint - found.value)
    if size <= floor:
        return FLAT
    if _equal(adjoint, found, tolerance):
        return AGREES
    if off <= FAR * found.noise or found.noise > max(ROUGH * size, floor, abs(found.value)):
        return TOO_ROUGH
    return DISAGREES


def _equal(adjoint: float, found: Estimate, tolerance: float) -> bool:
    """Return whether an adjoint equals the differences, within a tolerance or within their noise if that is small."""
    size, off = max(abs(adjoint), abs(found.value)), abs(adjoint - found.value)
    return off <= tolerance * size or off <= found.noise <= ROUGH * size


def _relative(a: float, b: float) -> float:
    size = max(abs(a), abs(b))
    return abs(a - b) / size if size > 0 else 0.0


def _two_slopes(ahead: Array, behind: Array, floor: Array, first: int) -> list[tuple[Estimate, Estimate]]:
    """Return the slopes to both sides at each step, from `first` on, if they differ: a kink is within that step."""
    pairs = [(_estimated(ahead, floor, k), _estimated(behind, floor, k)) for k in range(first, len(floor))]
    return [pair for pair in pairs if _differ(*pair)]


def _is_steady(scan: Array, found: Estimate, floor: Array) -> bool:
    """Return whether a slope is the same at all smaller steps, as beside a kink at the point itself."""
    return _smallest_steps(scan, floor) <= found.at


def _differ(a: Estimate, b: Estimate) -> bool:
    return abs(a.value - b.value) > FAR * max(a.noise, b.noise)


# --- the loss around a point ------------------------------------------------------------------------------------------


def values_around(loss: Loss, d: Array, steps: Array) -> Array:
    """Return f(x + h d) and f(x - h d) at steps h (2, n), NaN where a rollout failed."""
    return np.array([[_at(loss, sign * h * d) for h in steps] for sign in (1.0, -1.0)])


def _usual_values(loss: Loss, d: Array, rounding: float) -> Array:
    """Return the same at the usual steps, and at smaller ones while they show more."""
    around = values_around(loss, d, STEPS)
    for h in ALL_STEPS[len(STEPS) :]:
        if _settled(central(*around), rounding):
            break
        around = np.append(around, values_around(loss, d, np.array([h])), axis=1)
    return around


def _settled(scan: Array, rounding: float) -> bool:
    """Return whether the scan can end: there is a plateau, or changes are rounding errors, or rollouts fail."""
    floor = rounding / ALL_STEPS[: len(scan)]
    if not np.abs(np.diff(scan[-3:])).max() > floor[-1]:
        return True
    best = estimate(scan, floor)
    return best.noise <= ROUGH * abs(best.value)


def _at(loss: Loss, step: Array) -> float:
    try:
        return loss.value(loss.x + step)
    except (RolloutError, TrialFailed):
        return float("nan")  # the step is too large for the scene; smaller ones follow


def central(ahead: Array, behind: Array) -> Array:
    """Return E(h) at every step but the last."""
    D = (ahead - behind) / (2.0 * ALL_STEPS[: len(ahead)])
    return np.asarray((16.0 * D[1:] - D[:-1]) / 15.0)


def one_sided(values: Array, here: float, sign: float = 1.0) -> Array:
    """Return (4 D(h/4) - D(h)) / 3 at every step but the last, D(h) the difference to one side; of second order."""
    D = sign * (values - here) / ALL_STEPS[: len(values)]
    return np.asarray((4.0 * D[1:] - D[:-1]) / 3.0)


# --- plateaus ---------------------------------------------------------------------------------------------------------


def estimate(scan: Array, floor: Array) -> Estimate:
    """Return the derivative from a scan; `floor` is the rounding error at every step."""
    return _estimated(scan, floor, plateau(scan, floor))


def _estimated(scan: Array, floor: Array, at: int) -> Estimate:
    return Estimate(float(scan[at]), max(float(floor[at]), scatter(scan, at)), at)


def rounding_alone(scan: Array, most: float) -> float:
    """Return the observed error of the loss if a scan shows nothing else, so that E h has the same size everywhere.

    Otherwise, and if the error is larger than `most` as for a loss that saturates, return 0.
    """
    level = np.nan_to_num(np.abs(scan) * ALL_STEPS[: len(scan)])
    half = len(scan) // 2
    seen = 3.0 * float(level[half:].max())
    return seen if level[:half].max() <= seen <= most else 0.0


def plateau(scan: Array, floor: Array | float = 0.0) -> int:
    """Return where a scan is flattest, or among the smallest steps if they agree with each other but not with that.

    Args:
        scan: (n,)
        floor: its rounding error; the smallest steps agree if they differ by no more.
    """
    floor = np.broadcast_to(floor, scan.shape)
    best, first = _flattest(scan, floor), _smallest_steps(scan, floor)
    if first + 2 < len(scan) and _differ(*(_estimated(scan, floor, k) for k in (best, first + 1))):
        return first + 1
    return best


def _flattest(scan: Array, floor: Array) -> int:
    """Return where a scan changes least to both neighbours relative to its size."""
    change, floor = np.abs(np.diff(scan)), floor[1:-1]
    both = np.maximum(np.maximum(change[1:], change[:-1]), floor)
    size = np.maximum(np.abs(scan[1:-1]), floor)
    relative = np.divide(both, size, out=np.where(both == 0, 0.0, np.inf), where=size > 0)
    return 1 + int(np.nanargmin(relative)) if np.isfinite(relative).any() else len(scan) - 1


def _smallest_steps(scan: Array, floor: Array) -> int:
    """Return the largest of the steps from which a scan changes by rounding alone, down to its end."""
    changes = ~(np.abs(np.diff(scan)) <= floor[1:])
    return int(np.flatnonzero(changes)[-1]) + 1 if changes.any() else 0


def scatter(scan: Array, best: int) -> float:
    """Return the difference between a scan's plateau and its neighbours, which limits what can be resolved."""
    change = np.abs(np.diff(scan[max(0, best - 1) : best + 2]))
    return float(np.nanmax(change)) if np.isfinite(change).any() else 0.0

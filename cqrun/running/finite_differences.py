"""Compare an adjoint with finite differences along one direction.

Central differences D(h) = (f(x + h d) - f(x - h d)) / 2h for a scan of steps are extrapolated to fourth order,

    E(h) = (16 D(h/4) - D(h)) / 15.

Large steps have errors from curvature, small ones from rounding; between them is a plateau. It is where E changes least
from step to step relative to its size, which does not depend on the adjoint. There the two must agree. If a branch
changes between the points (contact, stick and slip), the plateau begins at smaller steps; so the scan continues below
its usual end while rounding errors are small. Without a plateau, differences are too rough to judge the adjoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from cqrun.errors import RolloutError
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.running.state_loss import Loss
from cqrun.store.result import Direction

ALL_STEPS = 1e-2 * 4.0 ** -np.arange(19)
"""Steps of the central differences in scaled coordinates, 1e-2 to 1e-13."""

STEPS = ALL_STEPS[:11]
"""The steps of every scan, down to 1e-8."""

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
FLAT: Final = "flat"
TOO_ROUGH: Final = "too rough"
DISAGREES: Final = "disagrees"


def check_direction(block: str, loss: Loss, value: float, gradient: Array, d: Array, precision: str) -> Direction:
    """Compare the gradient (n,) with differences along one direction d."""
    adjoint, count = float(gradient @ d), int(np.count_nonzero(d))
    eps, large = float(np.finfo(precision).eps), float(max(abs(value), loss.scale))
    rounding = NOISE * eps * large
    scan = extrapolated(lambda h: _central(loss, d, h), rounding)
    floor = max(rounding, rounding_alone(scan, MOST * eps**0.5 * large)) / ALL_STEPS[: len(scan)]
    best = plateau(scan, floor)
    differences, step = float(scan[best]), float(ALL_STEPS[best])
    noise = max(float(floor[best]), scatter(scan, best))
    shown = [float(e) if np.isfinite(e) else None for e in scan]
    result = Direction(
        block=block, count=count, adjoint=adjoint, differences=None, error=None, step=step, noise=noise, scan=shown,
        verdict=DISAGREES, agrees=False,
    )  # fmt: skip
    if not np.isfinite(differences):
        return result
    size, off = max(abs(adjoint), abs(differences)), abs(adjoint - differences)
    error = off / size if size > 0 else 0.0
    result.differences, result.error = differences, error
    if size <= floor[best]:
        result.verdict = FLAT
    elif error <= TOLERANCE[precision] or off <= noise <= ROUGH * size:
        result.verdict = AGREES
    elif noise > ROUGH * size and (off <= FAR * noise or noise > max(float(floor[best]), abs(differences))):
        result.verdict = TOO_ROUGH
    result.agrees = result.verdict in (AGREES, FLAT)
    return result


def _central(loss: Loss, d: Array, h: float) -> float:
    try:
        return (loss.value(loss.x + h * d) - loss.value(loss.x - h * d)) / (2.0 * h)
    except (RolloutError, TrialFailed):
        return float("nan")  # the step is too large for the scene; smaller ones follow


def extrapolated(central: Callable[[float], float], rounding: float = np.inf) -> Array:
    """Return E(h) at every step but the last, NaN if a rollout failed.

    Args:
        central: the central difference D(h).
        rounding: expected rounding error of the loss; the scan continues while it is small in E without a plateau.
    """
    D = [central(float(h)) for h in STEPS]
    scan = _of_fourth_order(D)
    for h in ALL_STEPS[len(STEPS) :]:
        if _settled(scan, rounding / ALL_STEPS[: len(scan)]):
            break
        D.append(central(float(h)))
        scan = _of_fourth_order(D)
    return scan


def _of_fourth_order(D: Sequence[float]) -> Array:
    return np.asarray((16.0 * np.array(D[1:]) - np.array(D[:-1])) / 15.0)


def _settled(scan: Array, floor: Array) -> bool:
    """Return whether the scan can end: there is a plateau, or changes are rounding errors, or rollouts fail."""
    if not np.abs(np.diff(scan[-3:])).max() > floor[-1]:
        return True
    best = plateau(scan, floor)
    return bool(max(scatter(scan, best), float(floor[best])) <= ROUGH * abs(scan[best]))


def rounding_alone(scan: Array, most: float) -> float:
    """Return the observed error of the loss if a scan shows nothing else, so that E h has the same size everywhere.

    Otherwise, and if the error is larger than `most` as for a loss that saturates, return 0.
    """
    level = np.nan_to_num(np.abs(scan) * ALL_STEPS[: len(scan)])
    half = len(scan) // 2
    seen = 3.0 * float(level[half:].max())
    return seen if level[:half].max() <= seen <= most else 0.0


def plateau(scan: Array, floor: Array | float = 0.0) -> int:
    """Return where a scan changes least to both neighbours relative to its size; `floor` is its rounding error."""
    change, floor = np.abs(np.diff(scan)), np.broadcast_to(floor, scan.shape)[1:-1]
    both = np.maximum(np.maximum(change[1:], change[:-1]), floor)
    size = np.maximum(np.abs(scan[1:-1]), floor)
    relative = np.divide(both, size, out=np.where(both == 0, 0.0, np.inf), where=size > 0)
    return 1 + int(np.nanargmin(relative)) if np.isfinite(relative).any() else len(scan) - 1


def scatter(scan: Array, best: int) -> float:
    """Return the difference between a scan's plateau and its neighbours, which limits what can be resolved."""
    change = np.abs(np.diff(scan[max(0, best - 1) : best + 2]))
    return float(np.nanmax(change)) if np.isfinite(change).any() else 0.0

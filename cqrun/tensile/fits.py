"""Fit a law to curves: many seeded starts, each with the moduli that are best for its other numbers.

A residual is the error of the nominal stress divided by the largest stress of its curve. All points count alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from cqrun.materials.curves import Mode
from cqrun.plugin.contract import Array
from cqrun.tensile.curve import Curve
from cqrun.tensile.laws import Law

STARTS = 6
"""Starts for each number of a law that is no modulus."""

FEW = 120
"""So many points of a curve are enough to look for the region of the optimum."""

FINE, COARSE, CAREFUL = 2, 40, 100
"""The best ends of so many starts are refined; evaluations of a search before that, and of the refinement."""

SAME = 1e-3
"""Ends whose sums of squares differ by less than this part are one."""

LARGEST_EXPONENT = 30.0
"""With larger exponents a term is a step, and its modulus a number that no scene can have."""

TRIES = 60
"""Random values of a law whose stress is not finite at the data are drawn again so many times."""

STEP = 1e-5
"""Relative step of the differences."""

RIDGE = 1e-4
"""Penalty on the moduli in units of the median secant: terms of a law that nearly cancel would grow without end, and
change the curve by less than its errors."""

_LARGEST = 1e100
"""Stress of a unit modulus, relative to the data, beyond which exponents make no sense."""

_FAR = 1e3
"""The residual where a law has no stress."""


@dataclass(frozen=True)
class Fit:
    """A law at its optimum.

    Attributes:
        law: the law.
        values: (p,) of its parameters.
        curves: what it was fitted to.
        residuals: (n,) of all curves, one after another.
    """

    law: Law
    values: Array
    curves: tuple[Curve, ...]
    residuals: Array

    @property
    def rms(self) -> float:
        """The root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @cached_property
    def parts(self) -> list[slice]:
        """Where the residuals of each curve are."""
        ends = np.cumsum([0, *(len(curve.stretch) for curve in self.curves)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]


def residuals_of(law: Law, values: Array, curves: Sequence[Curve]) -> Array:
    """Return the residuals (n,) of a law at all curves; `_FAR` where it has no stress."""
    return all_residuals(law, np.asarray(values)[None], curves)[0]


def all_residuals(law: Law, values: Array, curves: Sequence[Curve]) -> Array:
    """Return the residuals (m, n) for m sets of values (m, p)."""
    errors = [(law.stresses(values, c.mode, c.stretch) - c.stress) / c.largest_stress for c in curves]
    every = np.concatenate(errors, axis=1)
    return np.where(np.isfinite(every), np.clip(every, -_FAR, _FAR), _FAR)


def errors_by_mode(law: Law, values: Array, curves: Sequence[Curve]) -> dict[Mode, float]:
    """Return the root mean square error of each mode, relative to the largest stress of each curve."""
    found: dict[Mode, list[Array]] = {}
    for curve in curves:
        found.setdefault(curve.mode, []).append(residuals_of(law, values, [curve]))
    return {mode: float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for mode, parts in found.items()}


def fit_law(law: Law, curves: Sequence[Curve], near: Array | None = None, seed: int = 0) -> Fit | None:
    """Return the best fit of a law to curves; None if no start has a finite stress at the data.

    Args:
        near: values of a fit to similar data; with them the search has few starts of its own.
        seed: of the starts.
    """
    scale = _scale(curves)
    few = [curve.at(slice(None, None, max(1, len(curve.stretch) // FEW))) for curve in curves]
    starts = [*([] if near is None else [near]), *_starts(law, few, scale, np.random.default_rng(seed), near is None)]
    found = [_without_moduli(law, few, start, scale) for start in starts]
    if not found:
        return None
    found.sort(key=lambda end: end[0])
    apart = [end for k, end in enumerate(found) if k == 0 or end[0] > (1.0 + SAME) * found[k - 1][0]]
    ends = (_refined(law, curves, values, scale) for _, values in apart[: FINE if near is None else 1])
    values = _ordered(law, min(ends, key=lambda end: end[0])[1])
    return Fit(law, values, tuple(curves), residuals_of(law, values, curves))


def _scale(curves: Sequence[Curve]) -> float:
    """Return the size of a modulus [Pa]: the median secant of the curves."""
    secants = np.concatenate(
        [curve.stress / np.where(curve.stretch == 1.0, np.nan, curve.stretch - 1.0) for curve in curves]
    )
    return float(np.nanmedian(np.abs(secants))) / 3.0 or 1.0


def _starts(law: Law, curves: Sequence[Curve], scale: float, rng: np.random.Generator, many: bool) -> Iterator[Array]:
    """Yield values to start from: random numbers, and the moduli that are best with them."""
    free = [k for k, parameter in enumerate(law.parameters) if not parameter.is_modulus]
    for _ in range((STARTS if many else 1) * len(free) or 1):
        for _ in range(TRIES):
            values = np.ones(len(law.parameters))
            for k in free:
                least = law.parameters[k].least
                size = np.exp(rng.uniform(np.log(0.3), np.log(12.0 if least is None else 1000.0)))
                values[k] = least + size if least is not None else size * (1.0 if rng.random() < 0.7 else -1.0)
            if (values_there := _with_moduli(law, curves, values, scale)) is not None:
                yield values_there
                break


def _without_moduli(law: Law, curves: Sequence[Curve], values: Array, scale: float) -> tuple[float, Array]:
    """Return the sum of squares, and the values, where a search over the numbers that are no moduli ends.

    The moduli are at their optimum all the time (variable projection, Golub and Pereyra 1973).
    """
    from scipy.optimize import least_squares

    free = [k for k, parameter in enumerate(law.parameters) if not parameter.is_modulus]

    def whole(z: Array) -> Array | None:
        there = values.copy()
        there[free] = [law.parameters[k].from_free(x, scale) for k, x in zip(free, z, strict=True)]
        return _with_moduli(law, curves, there, scale)

    def residuals(z: Array) -> Array:
        there = whole(z)
        if there is None:
            return np.full(n + len(moduli), _FAR)
        return np.concatenate([residuals_of(law, there, curves), RIDGE * there[moduli] / scale])

    moduli = _moduli(law)
    n = sum(len(curve.stretch) for curve in curves)
    start = np.array([law.parameters[k].to_free(values[k], scale) for k in free])
    if free:
        end = least_squares(residuals, start, x_scale="jac", max_nfev=COARSE, ftol=1e-8)
        start = end.x
    best = whole(start)
    best = values if best is None else best
    return float(np.sum(residuals_of(law, best, curves) ** 2)), best


def _with_moduli(law: Law, curves: Sequence[Curve], values: Array, scale: float) -> Array | None:
    """Return values with the moduli that fit best, in which the stress is linear; None if it is not finite."""
    from scipy.optimize import nnls

    if any(abs(values[k]) > LARGEST_EXPONENT for k in law.exponents.values()):
        return None
    moduli = _moduli(law)
    unit = np.array([scale / (values[law.exponents[k]] or 1e-9) if k in law.exponents else scale for k in moduli])
    units = np.tile(values, (len(moduli), 1))
    units[:, moduli] = np.diag(unit)
    matrix = np.concatenate([law.stresses(units, c.mode, c.stretch) / c.largest_stress for c in curves], axis=1).T
    if not np.all(np.abs(matrix) < _LARGEST):
        return None
    sizes = np.linalg.norm(matrix, axis=0)
    sizes[sizes == 0.0] = 1.0
    rows = np.concatenate([matrix / sizes, np.diag(RIDGE * unit / scale / sizes)])
    measured = np.concatenate([*(c.stress / c.largest_stress for c in curves), np.zeros(len(moduli))])
    positive = [k in law.exponents for k in moduli]
    best = nnls(rows, measured)[0] if all(positive) else np.linalg.lstsq(rows, measured, rcond=None)[0]
    values = values.copy()
    values[moduli] = best / sizes * unit
    for k in moduli:
        least = law.parameters[k].least
        if least is not None:
            values[k] = max(values[k], least + 1e-3 * scale)
    return values


def _refined(law: Law, curves: Sequence[Curve], values: Array, scale: float) -> tuple[float, Array]:
    """Return the sum of squares, and the values, where a search over all parameters ends."""
    from scipy.optimize import least_squares

    def with_ridge(points: Array) -> Array:
        values = np.array([law.from_free(point, scale) for point in points])
        return np.concatenate([all_residuals(law, values, curves), RIDGE * values[:, moduli] / scale], axis=1)

    def residuals(free: Array) -> Array:
        return np.asarray(with_ridge(free[None])[0])

    def jacobian(free: Array) -> Array:
        steps = STEP * np.maximum(np.abs(free), 1.0)
        errors = with_ridge(np.concatenate([free + np.diag(steps), free - np.diag(steps)]))
        return np.asarray((errors[: len(free)] - errors[len(free) :]).T / (2.0 * steps))

    moduli, start = _moduli(law), law.to_free(values, scale)
    exact = {"x_scale": "jac", "ftol": 1e-11, "xtol": 1e-11}
    ends = [(float(np.sum(residuals(start) ** 2)), start)]
    for method in ("trf", "lm"):  # the second ends where the first creeps along a valley
        if method == "trf" or sum(len(curve.stretch) for curve in curves) >= len(start):
            end = least_squares(residuals, ends[-1][1], jacobian, method=method, max_nfev=CAREFUL, **exact)
            ends.append((float(2.0 * end.cost), end.x))
    cost, free = min(ends, key=lambda end: end[0])
    return cost, law.from_free(free, scale)


def _moduli(law: Law) -> list[int]:
    return [k for k, parameter in enumerate(law.parameters) if parameter.is_modulus]


def _ordered(law: Law, values: Array) -> Array:
    """Return values with equal terms in one order, by the size of their exponents, so that results compare."""
    if law.terms < 2 or len(values) % law.terms:
        return values
    terms = values.reshape(law.terms, -1)
    keys = np.array([p.is_modulus for p in law.parameters]).reshape(law.terms, -1)
    exponents = np.where(keys, 0.0, terms).sum(axis=1)
    return np.asarray(terms[np.argsort(np.abs(exponents), kind="stable")].ravel())

"""Compare laws that were fitted to the same curves, and choose one.

With two of the three modes the criterion is the error of each mode as predicted by a fit to the other, because the
third has to be predicted, too. With one mode or all three it is AICc, with as many values as the residuals of the best
fit count as (docs/decisions/017-material-tests.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from cqrun.materials.curves import MODES, Mode, stable_range
from cqrun.plugin.contract import Array
from cqrun.tensile.certainty import Certainty, certainty_of, independent_values
from cqrun.tensile.curve import Curve
from cqrun.tensile.fits import Fit, errors_by_mode, fit_law
from cqrun.tensile.laws import NU, Law
from cqrun.tensile.reading import modes_in

CLOSE = 0.002
"""A further term of a law has to lower the error by this part of the largest stress."""

GOOD = 0.02
"""A law fits well if its error is below this part of the largest stress."""

FARTHEST = 1.5
"""Stability is looked for up to this many times the largest stretch, and at least up to 10."""

LEAST_VALUES = 20
"""Curves of as many points count as so many values in the criterion, although their residuals may count as fewer: those
of a law that does not fit are alike because of the law, not because the data are."""

EXACT = 1e-9
"""Smaller residuals count as this: data that a law made have no errors."""


@dataclass(frozen=True)
class Judged:
    """A fitted law and all that is said of it.

    Attributes:
        fit: the law at its optimum.
        certainty: intervals of its parameters.
        criterion: AICc; only differences between laws mean something. Infinite for too many parameters.
        by_mode: error of each mode, relative to the largest stress.
        left_out: error of each mode if the law is fitted to the other modes; empty for one mode.
        stable: for each mode, the stretches between which the nominal stress grows.
        needed: for each mode, the smallest and largest stretch of the tested deformation.
    """

    fit: Fit
    certainty: Certainty
    criterion: float
    by_mode: dict[Mode, float]
    left_out: dict[Mode, float]
    stable: dict[Mode, tuple[float, float]]
    needed: dict[Mode, tuple[float, float]]

    @property
    def law(self) -> Law:
        """The law."""
        return self.fit.law

    @property
    def is_allowed(self) -> bool:
        """Whether a scene may have these parameters."""
        try:
            self.law.made(self.fit.values, NU)
        except ValidationError:
            return False
        return True

    @property
    def is_determined(self) -> bool:
        """Whether every parameter has an interval."""
        return None not in self.certainty.intervals.values()

    @property
    def prediction(self) -> float:
        """The root mean square of the errors of modes that were left out."""
        return float(np.sqrt(np.mean(np.square(list(self.left_out.values()))))) if self.left_out else 0.0

    @property
    def stable_to(self) -> float:
        """The smallest stretch above 1 at which the law is unstable in one of the three modes."""
        return min(high for _, high in self.stable.values())

    @property
    def unstable_in(self) -> dict[Mode, float]:
        """The modes in which the law is unstable inside the tested deformation, and the stretch where that begins."""
        found = {}
        for mode, (low, high) in self.needed.items():
            if self.stable[mode][1] < high:
                found[mode] = self.stable[mode][1]
            elif self.stable[mode][0] > low:
                found[mode] = self.stable[mode][0]
        return found


def judge(fits: Sequence[Fit], curves: Sequence[Curve]) -> list[Judged]:
    """Return what there is to say of each fitted law."""
    best = min(fits, key=lambda fit: fit.rms)
    samples = max(independent_values(best), min(LEAST_VALUES, len(best.residuals)))
    needed = _needed(curves)
    return [
        Judged(
            fit, certainty_of(fit), _aicc(fit, samples), errors_by_mode(fit.law, fit.values, curves),
            _left_out(fit, curves), _stable(fit, curves), needed,
        )
        for fit in fits
    ]  # fmt: skip


def one_of_each(fits: Sequence[Fit]) -> list[Fit]:
    """Return one fit of each law: with the fewest terms whose error is close to that of the best number of terms."""
    kept = []
    for name in dict.fromkeys(fit.law.name for fit in fits):
        own = [fit for fit in fits if fit.law.name == name]
        best = min(fit.rms for fit in own)
        kept.append(min((fit for fit in own if fit.rms <= best + CLOSE), key=lambda fit: fit.law.terms))
    return kept


def chosen(laws: Sequence[Judged]) -> Judged:
    """Return the best law by the criterion.

    Unstable laws count only if no other is left, and laws whose parameters the data cannot tell apart only if no other
    fits well: terms that nearly cancel say little of deformations that were not tested.
    """
    laws = [item for item in laws if item.is_allowed] or laws
    stable = [item for item in laws if not item.unstable_in]
    sure = [item for item in stable if item.is_determined and item.fit.rms < GOOD]
    return min(sure or stable or laws, key=_by_prediction if len(laws[0].by_mode) == 2 else _by_criterion)


def _by_prediction(item: Judged) -> tuple[float, float]:
    return item.prediction, item.fit.rms


def _by_criterion(item: Judged) -> tuple[float, float]:
    return item.criterion, item.fit.rms


def _aicc(fit: Fit, samples: float) -> float:
    """Return Akaike's criterion, corrected for few values (Hurvich and Tsai, 1989)."""
    k = len(fit.values) + 1
    if samples <= k + 1:
        return float("inf")
    mean = max(fit.rms, EXACT) ** 2
    return float(samples * np.log(mean) + 2 * k + 2 * k * (k + 1) / (samples - k - 1))


def _left_out(fit: Fit, curves: Sequence[Curve]) -> dict[Mode, float]:
    """Return the error of each mode as predicted by the law fitted to the other modes; empty for one mode."""
    modes = modes_in(curves)
    if len(modes) < 2:
        return {}
    found = {}
    for mode in modes:
        others = [curve for curve in curves if curve.mode != mode]
        other = fit_law(fit.law, others, near=fit.values)
        values = fit.values if other is None else other.values
        found[mode] = errors_by_mode(fit.law, values, [c for c in curves if c.mode == mode])[mode]
    return found


def _stable(fit: Fit, curves: Sequence[Curve]) -> dict[Mode, tuple[float, float]]:
    farthest = max(10.0, FARTHEST * max(float(curve.stretch.max()) for curve in curves))
    theta = fit.law.theta(fit.values)
    return {mode: stable_range(fit.law.spec, theta, mode, farthest) for mode in MODES}


def first_invariant(mode: Mode, stretch: Array) -> Array:
    """Return I1 (n,) of a body that keeps its volume, in a test."""
    second = stretch ** MODES[mode]
    return np.asarray(stretch**2 + second**2 + (stretch * second) ** -2.0)


def _needed(curves: Sequence[Curve]) -> dict[Mode, tuple[float, float]]:
    """Return the tested stretches of each mode; in others, those in tension with no larger first invariant."""
    largest = max(float(first_invariant(curve.mode, curve.stretch).max()) for curve in curves)
    found: dict[Mode, tuple[float, float]] = {}
    for mode in MODES:
        own = [curve for curve in curves if curve.mode == mode]
        if own:
            ends = [float(curve.stretch.min()) for curve in own], [float(curve.stretch.max()) for curve in own]
            found[mode] = min(1.0, *ends[0]), max(1.0, *ends[1])
        else:
            grid = np.geomspace(1.0, max(2.0, largest), 4000)
            found[mode] = 1.0, float(grid[first_invariant(mode, grid) <= largest].max())
    return found

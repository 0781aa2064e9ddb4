"""How certain the parameters of a fitted law are, and its moduli at rest (docs/decisions/007-intervals.md).

Each curve is one recording with one series of errors, in the order of the points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.fitting.identifiability import Unknown
from cqrun.fitting.uncertainty import Series, intervals, memory
from cqrun.plugin.contract import Array
from cqrun.tensile.fits import Fit, residuals_of

Interval = tuple[float, float]

STEP = 1e-5
"""Relative step of the central differences."""

WIDE, FAR = 1e6, 20.0
"""A value may be so many times larger or smaller (positive numbers), or move by so many times its size."""


@dataclass(frozen=True)
class Certainty:
    """What a fit says of its numbers.

    Attributes:
        intervals: 95 % interval of each parameter, or None.
        shear: interval of the shear modulus at rest [Pa], or None.
        findings: sentences on parameters that the data do not determine.
        samples: number of independent values that the residuals count as.
    """

    intervals: Mapping[str, Interval | None]
    shear: Interval | None
    findings: tuple[str, ...]
    samples: float


def independent_values(fit: Fit) -> float:
    """Return how many independent values the residuals count as: the sum of n / tau of the curves.

    tau is the integrated autocorrelation time by Geyer's sequence alone. The autoregression of decision 007 takes every
    smooth misfit for one constant error; it widens the intervals, but no law would be left to choose.
    """
    samples = 0.0
    for part in fit.parts:
        n = part.stop - part.start
        samples += n / float(np.clip(2.0 * memory(fit.residuals[part]).lags[0].sum() - 1.0, 1.0, n))
    return samples


def certainty_of(fit: Fit) -> Certainty:
    """Return the intervals of a fit's parameters and of its shear modulus at rest."""
    names = [parameter.name for parameter in fit.law.parameters]
    samples, n = independent_values(fit), len(fit.residuals)
    if samples <= len(names) or n <= len(names):
        if n <= len(names):
            why = f"it has {n} points for {len(names)} parameters"
        else:
            why = f"its errors count as {samples:.1f} independent values for {len(names)} parameters"
        return Certainty(dict.fromkeys(names), None, (f"no intervals: {why}",), samples)
    unknowns, jacobian = _unknowns(fit), _jacobian(fit)
    series = [
        Series(np.arange(part.start, part.stop), np.arange(part.stop - part.start), k)
        for k, part in enumerate(fit.parts)
    ]
    found = intervals(jacobian, fit.residuals, series, unknowns)
    shear = _interval_of_shear(fit, jacobian, series, unknowns)
    findings = [
        *found.findings,
        *(f"{name}: {why}" for name, why in found.reasons.items() if name not in " ".join(found.findings)),
    ]
    return Certainty(found.intervals, shear, tuple(findings), samples)


def _unknowns(fit: Fit) -> list[Unknown]:
    unknowns = []
    for k, (parameter, value) in enumerate(zip(fit.law.parameters, fit.values.tolist(), strict=True)):
        if value > 0.0 and (parameter.least is not None or k in fit.law.exponents):
            unknowns.append(Unknown(parameter.name, value, value / WIDE, value * WIDE, log=True))
        else:
            reach = FAR * max(abs(value), 1e-30)
            unknowns.append(Unknown(parameter.name, value, value - reach, value + reach))
    return unknowns


def _jacobian(fit: Fit) -> Array:
    """Return the derivatives (n, p) of the residuals by the working coordinates of the unknowns."""
    columns = []
    for k, unknown in enumerate(_unknowns(fit)):
        step = STEP * max(abs(fit.values[k]), 1e-30)
        moved = [fit.values + sign * step * np.eye(len(fit.values))[k] for sign in (1.0, -1.0)]
        ahead, behind = (residuals_of(fit.law, values, fit.curves) for values in moved)
        columns.append((ahead - behind) / (2.0 * step) * (unknown.value if unknown.log else 1.0))
    return np.array(columns).T


def _interval_of_shear(fit: Fit, jacobian: Array, series: Sequence[Series], unknowns: list[Unknown]) -> Interval | None:
    """Return the interval of mu at rest: it replaces the coordinate of the unknown that changes it most.

    With z_k replaced by log mu and g = d log mu / dz, the columns of the Jacobian become J_k / g_k and
    J_i - J_k g_i / g_k.
    """
    mu = fit.law.moduli(fit.values).shear
    if not mu > 0.0:
        return None
    slopes = []
    for k, unknown in enumerate(unknowns):
        step = STEP * max(abs(fit.values[k]), 1e-30)
        ahead, behind = (
            fit.law.moduli(fit.values + sign * step * np.eye(len(fit.values))[k]).shear for sign in (1.0, -1.0)
        )
        slopes.append((ahead - behind) / (2.0 * step) / mu * (unknown.value if unknown.log else 1.0))
    g = np.array(slopes)
    reach = g * np.array([u.ends[1] - u.ends[0] for u in unknowns])
    k = int(np.argmax(np.abs(reach)))
    changed = jacobian - np.outer(jacobian[:, k], g / g[k])
    changed[:, k] = jacobian[:, k] / g[k]
    replaced = [*unknowns]
    replaced[k] = Unknown("shear modulus", mu, mu / WIDE, mu * WIDE, log=True)
    return intervals(changed, fit.residuals, series, replaced).intervals["shear modulus"]

"""Identifiability: unknowns on which the data do not depend, and combinations that cannot be told apart.

The columns of the Jacobian are compared by their effect over the whole range of the bounds, to find flat unknowns, and
then by their directions, to find combinations that change no residual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array

FLAT = 1e-6
"""An unknown is flat if its range moves the residuals by less than this part of the strongest unknown's effect."""

TOGETHER = 1e-4
"""Singular values of the unit columns below this part of the largest belong to combinations without effect."""

_NAMED = 0.1
_TOUCHED = 0.03
_ALIKE = 0.98


@dataclass(frozen=True)
class Unknown:
    """One number that was fitted.

    Attributes:
        name: its key path.
        value: at the optimum, in its own unit.
        lower, upper: bounds in its own unit.
        log: whether its logarithm is fitted.
    """

    name: str
    value: float
    lower: float
    upper: float
    log: bool = False

    @property
    def coordinate(self) -> float:
        """The value in working coordinates."""
        return self.to_coordinate(self.value)

    @property
    def ends(self) -> tuple[float, float]:
        """The bounds in working coordinates."""
        return self.to_coordinate(self.lower), self.to_coordinate(self.upper)

    def to_coordinate(self, value: float) -> float:
        """Return the working coordinate of a value."""
        return math.log(value) if self.log else float(value)

    def from_coordinate(self, coordinate: float) -> float:
        """Return the value at a working coordinate."""
        return math.exp(coordinate) if self.log else float(coordinate)


@dataclass(frozen=True)
class Directions:
    """The directions of p unknowns that the columns of a Jacobian resolve.

    Attributes:
        inverse: (p, p) pseudo-inverse of J^T J without the directions that have no effect.
        rank: number of directions with an effect.
        reasons: why an unknown has no interval, by name.
        findings: sentences for the user.
        singular_values: of the unit columns, largest first.
    """

    inverse: Array
    rank: int
    reasons: dict[str, str]
    findings: tuple[str, ...]
    singular_values: Array


def find_directions(jacobian: Array, unknowns: Sequence[Unknown]) -> Directions:
    """Return flat unknowns and combinations that cannot be told apart.

    Args:
        jacobian: (n, p) dr/dz in working coordinates.
        unknowns: the p unknowns.
    """
    p = len(unknowns)
    sizes = np.linalg.norm(jacobian, axis=0)
    effects = sizes * np.array([u.ends[1] - u.ends[0] for u in unknowns])
    active = np.flatnonzero(effects > FLAT * effects.max(initial=0.0)).tolist()
    flat = [unknowns[i].name for i in sorted(set(range(p)) - set(active))]
    reasons = dict.fromkeys(flat, "the data do not depend on it")
    findings = [f"{name}: the data do not depend on it; fix it, or add data that do" for name in flat]
    if not active:
        return Directions(np.zeros((p, p)), 0, reasons, tuple(findings), np.zeros(0))
    _, s, Vt = np.linalg.svd(jacobian[:, active] / sizes[active], full_matrices=False)
    kept = s > TOGETHER * s[0]
    chosen = [unknowns[i] for i in active]
    for v in Vt[~kept]:
        findings.append(_combination(v / sizes[active], v, chosen))
    for i in np.flatnonzero(np.linalg.norm(Vt[~kept], axis=0) > _TOUCHED).tolist():
        reasons[chosen[i].name] = "cannot be told apart from other unknowns"
    back = (Vt[kept] / s[kept, None]) / sizes[active]
    inverse = np.zeros((p, p))
    inverse[np.ix_(active, active)] = back.T @ back
    findings += _alike(inverse, unknowns, reasons)
    return Directions(inverse, int(kept.sum()), reasons, tuple(findings), s)


def follow(jacobian: Array, residuals: Array, unknowns: Sequence[Unknown]) -> Array:
    """Return the values (p,) that fit best within the bounds for new residuals, to first order.

    Args:
        jacobian: (n, p) dr/dz in working coordinates.
        residuals: (n,) the new residuals at the current values.
        unknowns: the p unknowns; one whose column is zero keeps its value.
    """
    from scipy.optimize import lsq_linear

    here, (low, high) = np.array([u.coordinate for u in unknowns]), np.array([u.ends for u in unknowns]).T
    moved = here.copy()
    free = np.any(jacobian != 0.0, axis=0)
    if free.any():
        bounds = ((low - here)[free], (high - here)[free])
        moved[free] += lsq_linear(jacobian[:, free], -residuals, bounds, method="bvls").x
    return np.array([u.from_coordinate(z) for u, z in zip(unknowns, moved, strict=True)])


def _combination(change: Array, share: Array, unknowns: Sequence[Unknown]) -> str:
    """Return a sentence on a combination of unknowns without effect.

    `change` (p,) is its direction in working coordinates, `share` (p,) in units of each unknown's effect.
    """
    named = [int(i) for i in np.argsort(-np.abs(share)) if abs(share[i]) > _NAMED * np.abs(share).max()]
    lead = unknowns[named[0]]
    # 1 % of the first unknown: of its value on a log scale, of its range on a linear scale
    unit = 0.01 * (1.0 if lead.log else lead.ends[1] - lead.ends[0]) / change[named[0]]
    changes = [
        f"{unknowns[i].name} by {100 * unit * change[i]:+.3g} %"
        if unknowns[i].log
        else f"{unknowns[i].name} by {unit * change[i]:+.3g}"
        for i in named
    ]
    names = _listed([unknowns[i].name for i in named])
    return (
        f"{names} cannot be told apart: changing {_listed(changes)} together does not change the data; fix one of them"
    )


def _alike(inverse: Array, unknowns: Sequence[Unknown], reasons: dict[str, str]) -> list[str]:
    """Return sentences on pairs that are hard to tell apart."""
    resolved = [i for i, u in enumerate(unknowns) if u.name not in reasons]
    pairs = [(i, j) for a, i in enumerate(resolved) for j in resolved[a + 1 :]]
    alike = {(i, j): inverse[i, j] / np.sqrt(inverse[i, i] * inverse[j, j]) for i, j in pairs}
    return [
        f"{unknowns[i].name} and {unknowns[j].name} are hard to tell apart (correlation {rho:+.3f})"
        for (i, j), rho in alike.items()
        if abs(rho) > _ALIKE
    ]


def _listed(words: Sequence[str]) -> str:
    """Return `a, b and c`."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"

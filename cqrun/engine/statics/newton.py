"""Newton's method for equilibrium, with steps found by a Krylov method and shortened by the slope along them.

Energies are useless for the length of a step near the answer, where their differences are rounding; the slope
r(u + a p) . p is not. A step may pass the point at which the slope vanishes by half of the slope that it began with.
Near the answer a whole step is also taken if the residual falls by a tenth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cqrun.engine.statics.krylov import Solution, conjugate_gradients, dot
from cqrun.plugin.contract import Array

MOST_STEPS = 60
"""Steps of Newton's method."""

MOST_PRODUCTS = 3000
"""Products in one step."""

LOOSEST = 0.1
"""Relative residual of the linear system of a step, at most."""

FORCING = 0.9
"""Factor of the square of the last reduction of the net force, to which the next step is found (S. Eisenstat,
H. Walker: Choosing the forcing terms in an inexact Newton method, SIAM J. Sci. Comput. 17 (1996), choice 2)."""

SHORTEST = 1e-6
"""Part of a step below which no step helps: rounding, or no equilibrium in this direction."""


FLOOR = 1e-6
"""Relative residual below which steps that no longer help have met rounding, and not a lack of equilibrium."""

IN_VAIN = 3
"""Steps in a row that do not halve the smallest residual so far, after which it is taken for rounding below FLOOR."""


class System(Protocol):
    """Forces on nodes that can move."""

    def net(self, u: Array) -> Array:
        """Return the net force on every node (M, 4) [N], zero where nodes are held."""
        ...

    def linearise(self, u: Array) -> None:
        """Prepare `product` and `precondition` at a displacement (M, 4) [m]."""
        ...

    def product(self, p: Array) -> Array:
        """Return the stiffness matrix times a displacement."""
        ...

    def precondition(self, r: Array) -> Array:
        """Return a cheap approximation of the displacement that a force causes."""
        ...


@dataclass(frozen=True)
class Rest:
    """A displacement, and how it was found.

    Attributes:
        u: displacement of the nodes (M, 4) [m].
        residual: size of the net force, divided by that of the loads.
        converged: whether the residual is below the tolerance, or as small as rounding allows.
        steps, products: steps of Newton's method, and products with the stiffness matrix.
        negative: whether the stiffness matrix had a negative eigenvalue on the way to, or at, the answer.
        smallest: smallest eigenvalue of the preconditioned matrix that the last step saw; zero at a limit point.
        stuck: whether no step made the residual smaller.
        troubled: whether any step met negative curvature. (Slender bodies shorten steps on a straight way as well.)
        rounded: whether rounding ended the search above the tolerance.
    """

    u: Array
    residual: float
    converged: bool
    steps: int
    products: int
    negative: bool
    smallest: float
    stuck: bool
    troubled: bool = False
    rounded: bool = False


def find_rest(
    system: System, u: Array, load: float, tolerance: float, solver: Callable[..., Solution] = conjugate_gradients
) -> Rest:
    """Return where the system rests, from a first guess u (M, 4) [m].

    Args:
        load: size of the loads [N], by which the residual is measured.
        tolerance: relative residual at which the search ends.
        solver: of the linear systems; that of a symmetric matrix, or `minimal_residuals`.
    """
    r = system.net(u)
    size, eta = _size(r), LOOSEST
    steps = products = 0
    negative, troubled, stuck, smallest, best, in_vain = False, False, False, float("nan"), size, 0
    while size > tolerance * load and steps < MOST_STEPS and not stuck:
        system.linearise(u)
        eta = max(eta, min(LOOSEST, 0.3 * tolerance * load / size))
        found = solver(system.product, r, system.precondition, eta, MOST_PRODUCTS)
        steps, products = steps + 1, products + found.iterations
        negative = found.negative
        smallest = found.smallest if np.isfinite(found.smallest) else smallest
        before = size
        u, r, size, part = _step(system, u, r, size, found.x)
        stuck, troubled = part == 0.0, troubled or negative
        eta = min(LOOSEST, FORCING * (size / before) ** 2)
        in_vain = 0 if size <= 0.5 * best else in_vain + 1
        best = min(best, size)
        if size <= FLOOR * load and in_vain == IN_VAIN:
            break
    exact = size <= tolerance * load
    rounded = not exact and size <= FLOOR * load and (stuck or in_vain >= IN_VAIN)
    relative = size / load if load > 0 else size
    return Rest(u, relative, exact or rounded, steps, products, negative, smallest, stuck, troubled, rounded)


def _step(system: System, u: Array, r: Array, size: float, p: Array) -> tuple[Array, Array, float, float]:
    """Return the displacement, net force and its size after a step along p, and the part of p that helps; 0 if none."""
    slope, a = dot(r, p), 1.0
    while a >= SHORTEST:
        trial = u + a * p
        r_trial = system.net(trial)
        size_trial = _size(r_trial)
        if np.isfinite(size_trial) and (-0.5 * slope <= dot(r_trial, p) < slope or size_trial <= 0.9 * size):
            return trial, r_trial, size_trial, a
        a *= 0.5
    return u, r, size, 0.0


def _size(r: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(dot(r, r)))

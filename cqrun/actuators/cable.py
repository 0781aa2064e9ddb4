"""Cable: it pulls the particles of its route together if it is taut, and does nothing if it is slack (CQ2 eqs 16, 17).

With the route's particles x_1 .. x_r, the length L = sum_i |x_{i+1} - x_i|, its rest length R, the stiffness k and the
activation u, the share of R that is not reeled in:

    E = k / 2 max(0, L - max(0, u) R)^2,    f = -dE/dx

The tension T = k max(0, L - max(0, u) R) is the same along the whole route: f_i = T (t_i - t_{i-1}) with the unit
vectors t_i = (x_{i+1} - x_i) / |x_{i+1} - x_i|. It adds no net force and no net torque. A cable with a given `tension`
has the law of `tension.py` instead.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from pydantic import model_validator

from cqrun.actuators.actuator import Actuator
from cqrun.actuators.tension import TensionKernel
from cqrun.explain import Loc, complaint, finding
from cqrun.forces.force import ACTIVATION, REST, STRENGTH, Inside, Levels, Shares, register_force
from cqrun.forces.route import (
    Point,
    clear_item,
    length_along,
    particles_along,
    pull_along,
    pull_along_vjp,
    route_length,
    route_length_vjp,
    route_problem,
    route_problems,
    segments_of,
    tension_bar,
)
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class CableKernel(NamedTuple):
    """All cables of a scene that have a stiffness."""

    shares: Shares
    parts: Array
    constants: Array


@plugin("actuator", "cable")
class Cable(Actuator):
    """A cable along a route of particles: it pulls and never pushes (CQ2 eqs 16, 17).

    With `stiffness`, a motor sets its length. The activation is the share of its rest length that is not reeled in: 1
    is slack at rest, 0 is fully reeled in. The tension is stiffness (length - activation rest length), or zero if that
    is negative.

    With `tension`, a motor or a weight sets its force. The tension is activation tension, whatever its length: 0 is
    slack, 1 pulls with the full tension.

    The tension is the same along the whole route: there is no friction.
    """

    route: list[Point] = quantity(
        "m", "Points at rest, joined by straight lines; the cable is tied to the nearest particle of each", min_length=2
    )
    spacing: float | None = quantity(
        "m", "Distance between the particles that it is tied to along a line; only at the points if absent", gt=0,
        default=None,
    )  # fmt: skip
    stiffness: float | None = quantity(
        "N/m", "Tension divided by stretch; or give `tension`", differentiable=True, ge=0, default=None
    )
    tension: float | None = quantity(
        "N", "Tension at activation 1, whatever its length; or give `stiffness`", differentiable=True, ge=0,
        default=None,
    )  # fmt: skip

    @model_validator(mode="after")
    def _one_law(self) -> Self:
        if (self.stiffness is None) == (self.tension is None):
            given = "neither" if self.stiffness is None else "both"
            message = (
                f"needs exactly one of `stiffness` (a motor sets its length) and `tension` (its force); has {given}"
            )
            raise complaint("Cable", [finding(message, involves=("stiffness", "tension"))])
        return self

    @property
    def scale(self) -> str:  # type: ignore[override]
        """The differentiable field that an activation is multiplied by."""
        return "tension" if self.stiffness is None else "stiffness"

    @property
    def neutral(self) -> float:  # type: ignore[override]
        """The activation at which it is slack."""
        return 0.0 if self.stiffness is None else 1.0

    @property
    def kernel(self) -> type:  # type: ignore[override]
        """The class of the kernels' view."""
        return TensionKernel if self.stiffness is None else CableKernel

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and largest activation."""
        return 0.0, 1.0

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return super().dim_problems(dim) + route_problems(self.route, dim)

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles along the route, in order; see `Actuator.particles`."""
        return particles_along(self.route, self.spacing, self.body, x, inside)

    def problem(self, x: Array, dx: float) -> str | None:
        """Return the error in a route along particles at x (r, D) [m] with cells of dx [m], or None."""
        return route_problem(self.route, self.body, x, dx)

    def constants(self, x: Array) -> Array:
        """Return nothing."""
        return np.zeros(0)

    def rest_length(self, x: Array) -> float:
        """Return the length [m] of a route along particles at x (r, D) [m]."""
        return route_length(x)

    def rest_length_vjp(self, x: Array, bar: float) -> Array:
        """Return the cotangent of x (r, D)."""
        return route_length_vjp(x, bar)

    def pull(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the tension [N] at each moment (T,), for the length and the activation then (T,)."""
        if self.stiffness is None:
            return np.asarray(activation * strength)
        slack = length - np.maximum(activation, 0.0) * rest
        return np.asarray(strength * np.maximum(slack, 0.0))

    def pull_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,).

        The derivatives at the kinks are those of the kernel: of a taut cable, and of an activation above 0.
        """
        if self.stiffness is None:
            return 0.0 * bar, strength * bar, activation * bar, 0.0 * bar
        reeled_out = np.maximum(activation, 0.0)
        slack = length - reeled_out * rest
        taut = np.where(slack >= 0.0, strength * bar, 0.0)
        by_activation = np.where(activation >= 0.0, -rest * taut, 0.0)
        return taut, by_activation, np.maximum(slack, 0.0) * bar, -reeled_out * taut

    def stored(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the energy [J] whose derivative by the length is the tension (T,)."""
        if self.stiffness is None:
            return np.asarray(activation * strength * length)
        return np.asarray(0.5 * strength * np.maximum(length - np.maximum(activation, 0.0) * rest, 0.0) ** 2)

    def stored_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,)."""
        tension = self.pull(length, activation, strength, rest)
        if self.stiffness is None:
            return tension * bar, strength * length * bar, activation * length * bar, 0.0 * bar
        slack = np.maximum(length - np.maximum(activation, 0.0) * rest, 0.0)
        by_activation = np.where(activation >= 0.0, -rest * tension * bar, 0.0)
        return tension * bar, by_activation, 0.5 * slack**2 * bar, -np.maximum(activation, 0.0) * tension * bar

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness at a node between two segments [N/m]: of stretch, or against turning under tension.

        A segment of length l under a tension T turns back with the stiffness T / l.
        """
        if self.stiffness is not None:
            return 4.0 * strength
        return 4.0 * strength / float(np.linalg.norm(np.diff(x, axis=0), axis=1).min())


@kernel
def reeled(u: float) -> float:
    """Return max(0, u)."""
    return 0.0 if u <= 0.0 else u


@kernel
def pull(cables: CableKernel, item: int, levels: Levels, control: int, q: Array) -> None:
    """Write the shares of one cable."""
    a, shares = cables.parts[item], cables.shares
    left = reeled(levels.activation[control, a]) * levels.rest[a]
    tension = levels.strength[a] * (length_along(shares, item, q) - left)
    # NaN must pull too: then the rollout reports the particles that it moves
    if not tension <= 0.0:
        pull_along(shares, item, tension, q)
    else:
        clear_item(shares.force, shares, item)


@kernel
def pull_vjp(cables: CableKernel, item: int, levels: Levels, control: int, q: Array, push_bar: Array) -> None:
    """Carry the cotangent of the forces back through the tension and the segments' directions."""
    a, shares = cables.parts[item], cables.shares
    u, stiffness = levels.activation[control, a], levels.strength[a]
    s = length_along(shares, item, q) - reeled(u) * levels.rest[a]
    # one-sided derivatives at the kinks: at s = 0 that of a stretched cable, at u = 0 that of u > 0 (the legal side)
    shares.level_bar[item, :] = 0.0
    if s >= 0.0:
        T_bar = tension_bar(shares, item, q, push_bar)
        length_bar = stiffness * T_bar
        shares.level_bar[item, STRENGTH] = s * T_bar
        shares.level_bar[item, REST] = -(reeled(u) * length_bar)
        if u >= 0.0:
            shares.level_bar[item, ACTIVATION] = -(levels.rest[a] * length_bar)
        pull_along_vjp(shares, item, stiffness * s, length_bar, q, push_bar)
    else:
        clear_item(shares.x_bar, shares, item)


register_force(CableKernel, segments_of, pull, pull_vjp, rate=False)

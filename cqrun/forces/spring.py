"""Spring: it pulls and pushes the particles along its route towards its rest length.

With the length L of the route (`route.py`), its rest length R and the stiffness k, the energy is E = k / 2 (L - R)^2,
so the tension is T = k (L - R), negative where the spring is compressed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import Field

from cqrun.explain import Loc
from cqrun.forces.force import REST, STRENGTH, Levels, ParticleForce, Shares, register_force
from cqrun.forces.route import (
    Point,
    length_along,
    pull_along,
    pull_along_vjp,
    route_problem,
    route_problems,
    segments_of,
    tension_bar,
)
from cqrun.forces.routed import Routed
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import BodyName
from cqrun.plugin.registry import plugin


class SpringKernel(NamedTuple):
    """All springs of a scene."""

    shares: Shares
    parts: Array
    constants: Array


@plugin("force", "spring")
class Spring(Routed, ParticleForce):
    """A spring along a route through a body: its force is stiffness (length - rest length).

    It pulls if it is stretched, and pushes if it is compressed. In the reference frame it acts at the exact points of
    its route, which move with the material around them; in the updated frame it is tied to the nearest particle of
    each.
    """

    body: BodyName = Field(description="Body that contains it")
    route: list[Point] = quantity("m", "Points at rest in the body, joined by straight lines", min_length=2)
    free: bool = Field(
        description="Whether its lines may leave the body between the points of the route; if not, there is a warning",
        default=False,
    )
    stiffness: float = quantity("N/m", "Force divided by stretch", differentiable=True, ge=0)

    scale = "stiffness"
    kernel = SpringKernel

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return super().dim_problems(dim) + route_problems(self.route, dim)

    def problem(self, x: Array, dx: float) -> str | None:
        """Return the error in a route along particles at x (r, D) [m] with cells of dx [m], or None."""
        return route_problem(self.route, self.body, x, dx)

    def pull(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the tension [N] at each moment (T,), for the length then (T,)."""
        return np.asarray(strength * (length - rest))

    def pull_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,)."""
        return strength * bar, 0.0 * bar, (length - rest) * bar, -strength * bar

    def stored(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the energy [J] whose derivative by the length is the tension (T,)."""
        return np.asarray(0.5 * strength * (length - rest) ** 2)

    def stored_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,)."""
        pulled = strength * (length - rest) * bar
        return pulled, 0.0 * bar, 0.5 * (length - rest) ** 2 * bar, -pulled

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness at a node between two segments of the spring's stiffness [N/m]."""
        return 4.0 * strength


@kernel
def stretch(springs: SpringKernel, item: int, levels: Levels, control: int, q: Array) -> None:
    """Write the shares of one spring."""
    a = springs.parts[item]
    tension = levels.strength[a] * (length_along(springs.shares, item, q) - levels.rest[a])
    pull_along(springs.shares, item, tension, q)


@kernel
def stretch_vjp(springs: SpringKernel, item: int, levels: Levels, control: int, q: Array, push_bar: Array) -> None:
    """Carry the cotangent of the forces back."""
    a, shares = springs.parts[item], springs.shares
    stiffness, longer = levels.strength[a], length_along(shares, item, q) - levels.rest[a]
    T_bar = tension_bar(shares, item, q, push_bar)
    shares.level_bar[item, STRENGTH] = longer * T_bar
    shares.level_bar[item, REST] = -stiffness * T_bar
    pull_along_vjp(shares, item, stiffness * longer, stiffness * T_bar, q, push_bar)


register_force(SpringKernel, segments_of, stretch, stretch_vjp, rate=False)

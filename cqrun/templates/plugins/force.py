"""A force of your own between particles. Here it is a rope: it pulls where it is stretched, and never pushes.

With the length L of its route and the length R at rest, the tension is T = k max(L - R, 0). Change `pull` to your
force, and `pull_vjp` to its adjoint: `cqrun gradcheck my_force.yaml --allow-plugins` checks that the two agree.
"""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from cqrun.explain import Loc
from cqrun.forces.force import REST, STRENGTH, Inside, Levels, ParticleForce, Shares, register_force
from cqrun.forces.route import (
    Point,
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
from cqrun.plugin.reference import BodyName
from cqrun.plugin.registry import plugin


class MyForceKernel(NamedTuple):
    """What kernels see: all ropes of a scene."""

    shares: Shares
    parts: Array
    constants: Array


@plugin("force", "my_force")
class MyForce(ParticleForce):
    """A rope along a route of particles: its tension is stiffness (length - length at rest), or zero if it is slack.

    This text is the page of the force: `cqrun describe force my_force --plugin my_force.py`.
    """

    body: BodyName = Field(description="Body that contains it")
    route: list[Point] = quantity(
        "m", "Points at rest, joined by straight lines; it is tied to the nearest particle of each", min_length=2
    )
    stiffness: float = quantity("N/m", "Tension divided by stretch", differentiable=True, ge=0)

    scale = "stiffness"  # the field that is the strength of the force
    kernel = MyForceKernel

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return super().dim_problems(dim) + route_problems(self.route, dim)

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles along the route, in order."""
        return particles_along(self.route, None, self.body, x, inside)

    def problem(self, x: Array, dx: float) -> str | None:
        """Return the error in a route along particles at x (r, D) [m] with cells of dx [m], or None."""
        return route_problem(self.route, self.body, x, dx)

    def rest_length(self, x: Array) -> float:
        """Return the length [m] of a route along particles at x (r, D) [m]."""
        return route_length(x)

    def rest_length_vjp(self, x: Array, bar: float) -> Array:
        """Return the cotangent of x (r, D)."""
        return route_length_vjp(x, bar)

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness at a node between two segments of the rope [N/m]; it bounds the time step."""
        return 4.0 * strength


@kernel
def pull(ropes: MyForceKernel, item: int, levels: Levels, control: int, q: Array) -> None:
    """Write the forces of one rope."""
    a = ropes.parts[item]
    longer = max(length_along(ropes.shares, item, q) - levels.rest[a], 0.0)
    pull_along(ropes.shares, item, levels.strength[a] * longer, q)


@kernel
def pull_vjp(ropes: MyForceKernel, item: int, levels: Levels, control: int, q: Array, push_bar: Array) -> None:
    """Carry the cotangent of the forces back."""
    a, shares = ropes.parts[item], ropes.shares
    stretch = length_along(shares, item, q) - levels.rest[a]
    longer, stiffness = max(stretch, 0.0), levels.strength[a] if stretch > 0.0 else 0.0
    T_bar = tension_bar(shares, item, q, push_bar)
    shares.level_bar[item, STRENGTH] = longer * T_bar
    shares.level_bar[item, REST] = -stiffness * T_bar
    pull_along_vjp(shares, item, stiffness * longer, stiffness * T_bar, q, push_bar)


register_force(MyForceKernel, segments_of, pull, pull_vjp, rate=False)

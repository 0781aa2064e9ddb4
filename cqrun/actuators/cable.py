"""Cable: it pulls the particles of its route together if it is taut, and does nothing if it is slack (CQ2 eqs 16, 17).

With the route's particles x_1 .. x_r, the length L = sum_i |x_{i+1} - x_i|, its rest length R, the stiffness k and the
activation u, the share of R that is not reeled in:

    E = k / 2 max(0, L - max(0, u) R)^2,    f = -dE/dx

The tension T = k max(0, L - max(0, u) R) is the same along the whole route: f_i = T (t_i - t_{i-1}) with the unit
vectors t_i = (x_{i+1} - x_i) / |x_{i+1} - x_i|. It adds no net force and no net torque. A cable with a given `tension`
has the law of `tension.py` instead, and one that rubs, or a spool with several routes, that of `tendon.py`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.actuators.actuator import Actuator
from cqrun.actuators.tendon import (
    MOST_ROUTES,
    Line,
    SpoolKernel,
    TendonKernel,
    lines_of,
    tendon_constants,
)
from cqrun.actuators.tension import TensionKernel
from cqrun.explain import Loc, complaint, finding
from cqrun.forces.force import ACTIVATION, REST, STRENGTH, Levels, Shares, register_force
from cqrun.forces.helix import Helix
from cqrun.forces.route import (
    Point,
    clear_item,
    length_along,
    pull_along,
    pull_along_vjp,
    route_length,
    route_length_vjp,
    route_problem,
    route_problems,
    segments_of,
    tension_bar,
)
from cqrun.forces.routed import Routed, Way
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class CableKernel(NamedTuple):
    """All cables of a scene that have a stiffness."""

    shares: Shares
    parts: Array
    constants: Array


@plugin("actuator", "cable")
class Cable(Routed, Actuator):
    """A cable along a route through a body: it pulls and never pushes (CQ2 eqs 16, 17).

    With `stiffness`, a motor sets its length. The activation is the share of its rest length that is not reeled in: 1
    is slack at rest, 0 is fully reeled in. The tension is stiffness (length - activation rest length), or zero if that
    is negative.

    With `tension`, a motor or a weight sets its force. The tension is activation tension, whatever its length: 0 is
    slack, 1 pulls with the full tension.

    The motor pulls at the first point of the route, or at the `pulley`. Without `friction` the tension is the same
    along the whole route. With it, a bend by the angle t leaves exp(-friction t) of the tension, as around a capstan,
    for a cable that is being pulled in.

    With `routes` there are several cables on one spool, with one activation. What it winds up of those with the sign 1
    it lets out of those with -1, which pull at negative activations (`tension`), or above 1 (`stiffness`).

    In the reference frame the cable acts at the exact points of its route, which move with the material around them. In
    the updated frame it is tied to the nearest particle of each.
    """

    route: list[Point] | None = quantity(
        "m", "Points at rest in the body, joined by straight lines; or give `routes` or `helix`", min_length=2,
        default=None,
    )  # fmt: skip
    routes: list[list[Point]] | None = quantity(
        "m", "Routes of several cables on one spool", min_length=2, max_length=MOST_ROUTES, default=None
    )
    signs: list[Literal[-1, 1]] | None = Field(
        description="For each of `routes`, whether the spool winds it up (1) or lets it out (-1); all 1 if absent",
        default=None,
    )
    helix: Helix | None = Field(description="A guide that winds around an axis, in place of `route`", default=None)
    pulley: list[float] | None = quantity(
        "m", "Point of the world from which the motor pulls, before the first point of the route", default=None,
        min_length=2, max_length=3,
    )  # fmt: skip
    anchor: list[float] | None = quantity(
        "m", "Point of the world to which the far end is tied, after the last point of the route", default=None,
        min_length=2, max_length=3,
    )  # fmt: skip
    spacing: float | None = quantity(
        "m", "Distance between the points at which it acts along a line; only at the points of the route if absent",
        gt=0, default=None,
    )  # fmt: skip
    free: bool = Field(
        description="Whether its lines may leave the body between the points of the route; if not, there is a warning",
        default=False,
    )
    stiffness: float | None = quantity(
        "N/m", "Tension divided by stretch; or give `tension`", differentiable=True, ge=0, default=None
    )
    tension: float | None = quantity(
        "N", "Tension at activation 1, whatever its length; or give `stiffness`", differentiable=True, ge=0,
        default=None,
    )  # fmt: skip
    friction: float | None = quantity(
        "1", "Coefficient of friction in its guide; no friction if absent", differentiable=True, ge=0, default=None
    )

    @model_validator(mode="after")
    def _one_law(self) -> Self:
        if (self.stiffness is None) == (self.tension is None):
            given = "neither" if self.stiffness is None else "both"
            message = (
                f"needs exactly one of `stiffness` (a motor sets its length) and `tension` (its force); has {given}"
            )
            raise complaint("Cable", [finding(message, involves=("stiffness", "tension"))])
        guides = [name for name in ("route", "routes", "helix") if getattr(self, name) is not None]
        if len(guides) != 1:
            has = " and ".join(f"`{name}`" for name in guides) or "none"
            message = f"needs exactly one of `route`, `routes` and `helix`; has {has}"
            raise complaint("Cable", [finding(message, involves=("route", "routes", "helix"))])
        if self.signs is not None and len(self.signs) != len(self.routes or ()):
            message = f"needs one sign for each of `routes`; has {len(self.signs)} for {len(self.routes or ())}"
            raise complaint("Cable", [finding(message, involves=("signs",))])
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
        if self.friction is not None:
            return TendonKernel
        if self.routes is not None:
            return SpoolKernel
        return TensionKernel if self.stiffness is None else CableKernel

    @property
    def frame(self) -> str | None:  # type: ignore[override]
        """The only frame in which it acts: points of the world are known in the reference frame alone."""
        return None if self.pulley is None and self.anchor is None else "reference"

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and largest activation."""
        both = -1 in (self.signs or ())
        if self.stiffness is None:
            return -1.0 if both else 0.0, 1.0
        return 0.0, 2.0 if both else 1.0

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems = super().dim_problems(dim) + route_problems(self.route or [], dim)
        for k, route in enumerate(self.routes or ()):
            problems += [(("routes", k, *loc[1:]), message) for loc, message in route_problems(route, dim)]
            problems += [(("routes", k), "needs at least two points")] if len(route) < 2 else []
        if self.helix is not None:
            problems += [(("helix", *loc), message) for loc, message in self.helix.dim_problems(dim)]
        return problems

    def ways(self) -> list[Way]:
        """Return its routes."""
        before, after = (None if end is None else np.array(end) for end in (self.pulley, self.anchor))
        if self.helix is not None:
            return [Way(self.helix.points(self.spacing), None, before, after)]
        given = self.routes or [self.route]
        return [Way(np.array(route), self.spacing, before, after) for route in given]

    def problem(self, x: Array, dx: float) -> str | None:
        """Return the error in a route along particles at x (r, D) [m] with cells of dx [m], or None."""
        return route_problem(self.route or [], self.body, x, dx)

    def constants(self, x: Array) -> Array:
        """Return the constants of a cable with one route along points at x (r, D) [m]."""
        return self.constants_along([x])

    def constants_along(self, x: list[Array]) -> Array:
        """Return the constants of its kernel, for the points of each route at rest (r, D) [m]."""
        if self.kernel not in (TendonKernel, SpoolKernel):
            return np.zeros(0)
        first, lines = route_length(x[0]), []
        for of_route, sign in zip(x, self.signs or [1] * len(x), strict=True):
            begin = 0.0 if self.stiffness is None else route_length(of_route) / first - sign
            lines.append(Line(len(of_route), begin, float(sign)))
        return tendon_constants(self.stiffness is not None, lines)

    def lines(self, constants: Array, count: int) -> list[Line]:
        """Return its routes as its kernel has them, for its constants and the number of its points."""
        return lines_of(constants) if len(constants) else [Line(count, 0.0, 1.0)]

    def rest_size(self, x: Array, constants: Array) -> float:
        """Return the length at rest of its first route [m]; x (n, D) are the points of all its routes."""
        return route_length(x[: self.lines(constants, len(x))[0].points])

    def rest_size_vjp(self, x: Array, constants: Array, bar: float) -> Array:
        """Return the cotangent of x (n, D)."""
        out, count = np.zeros(x.shape), self.lines(constants, len(x))[0].points
        out[:count] = route_length_vjp(x[:count], bar)
        return out

    def pull(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the tension [N] at each moment (T,), for the length and the activation then (T,)."""
        reeled_out = np.maximum(activation, 0.0)
        if self.stiffness is None:
            return np.asarray(reeled_out * strength)
        return np.asarray(strength * np.maximum(length - reeled_out * rest, 0.0))

    def pull_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,).

        The derivatives at the kinks are those of the kernel: of a taut cable, and of an activation above 0.
        """
        reeled_out = np.maximum(activation, 0.0)
        if self.stiffness is None:
            return 0.0 * bar, np.where(activation >= 0.0, strength * bar, 0.0), reeled_out * bar, 0.0 * bar
        slack = length - reeled_out * rest
        taut = np.where(slack >= 0.0, strength * bar, 0.0)
        by_activation = np.where(activation >= 0.0, -rest * taut, 0.0)
        return taut, by_activation, np.maximum(slack, 0.0) * bar, -reeled_out * taut

    def stored(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the energy [J] whose derivative by the length is the tension (T,)."""
        reeled_out = np.maximum(activation, 0.0)
        if self.stiffness is None:
            return np.asarray(reeled_out * strength * length)
        return np.asarray(0.5 * strength * np.maximum(length - reeled_out * rest, 0.0) ** 2)

    def stored_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,)."""
        tension, reeled_out = self.pull(length, activation, strength, rest), np.maximum(activation, 0.0)
        if self.stiffness is None:
            by_activation = np.where(activation >= 0.0, strength * length * bar, 0.0)
            return tension * bar, by_activation, reeled_out * length * bar, 0.0 * bar
        slack = np.maximum(length - reeled_out * rest, 0.0)
        by_activation = np.where(activation >= 0.0, -rest * tension * bar, 0.0)
        return tension * bar, by_activation, 0.5 * slack**2 * bar, -reeled_out * tension * bar

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness at a node between two segments [N/m]: of stretch, or against turning under tension.

        A segment of length l under a tension T turns back with the stiffness T / l.
        """
        more = 1.0 + (self.friction or 0.0)  # a bend changes all the tension after it
        if self.stiffness is not None:
            return 4.0 * more * strength
        gaps = np.linalg.norm(np.diff(x, axis=0), axis=1)
        return 4.0 * more * strength / float(gaps[gaps > 0.0].min())


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

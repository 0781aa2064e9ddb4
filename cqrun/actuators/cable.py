"""Cable: pulls the particles along its route together when it is reeled in; slack, it does nothing (CQ2 eqs 16, 17).

With the route's particles x_1 .. x_r, the length L = sum_i |x_{i+1} - x_i|, its rest value R, the stiffness k and
the activation u, the share of R that is left:

    E = k / 2 max(0, L - max(0, u) R)^2,    f = -dE/dx

The tension T = k max(0, L - max(0, u) R) is the same all along: f_i = T (t_i - t_{i-1}) with the unit vectors
t_i = (x_{i+1} - x_i) / |x_{i+1} - x_i|. It adds no net force and no net torque.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np

from cqrun.actuators.actuator import Actuator, Inside, Point
from cqrun.actuators.push import register_push, starts_of
from cqrun.explain import Loc
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class Kernel(NamedTuple):
    """All cables of a scene."""

    start: Array  # (A_k + 1,) where a cable's particles begin
    columns: Array  # particles along the routes, in order
    actuators: Array  # (A_k,)


@plugin("actuator", "cable")
class Cable(Actuator):
    """A cable along a route of particles: it pulls and never pushes (CQ2 eqs 16, 17).

    The activation is the share of its rest length that is left: 1 is slack at rest, 0 fully reeled in. The tension
    is stiffness (length - activation rest length), or nought where that is negative.
    """

    route: list[Point] = quantity(
        "m", "Points at rest that it runs through in straight lines, each at the nearest particle", min_length=2
    )
    spacing: float | None = quantity(
        "m", "Distance between particles that it is tied to along a line; at the points alone if absent", gt=0,
        default=None,
    )  # fmt: skip
    stiffness: float = quantity("N/m", "Tension over stretch", differentiable=True, ge=0)

    scale = "stiffness"
    neutral = 1.0
    kernel = Kernel

    @property
    def limits(self) -> tuple[float, float]:
        """The least and greatest activation."""
        return 0.0, 1.0

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return (
            super().dim_problems(dim)
            + [
                (("route", k), f"must have {dim} entries in this {dim}D world, has {len(point)}")
                for k, point in enumerate(self.route)
                if len(point) != dim
            ]
            + [
                (("route", k + 1), "is where the point before it is: remove one of the two")
                for k, (one, next_one) in enumerate(itertools.pairwise(self.route))
                if one == next_one
            ]
        )

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles along the route, in order; see `Actuator.particles`."""
        own = inside(self.body, None)

        def nearest(place: Array) -> int:
            return int(own[np.argmin(((x[own] - place) ** 2).sum(axis=1))])

        points = np.array(self.route)
        tied = [nearest(point) for point in points]
        route = tied[:1]
        for k, (begin, end) in enumerate(itertools.pairwise(points)):
            pieces = 1 if self.spacing is None else max(1, round(float(np.linalg.norm(end - begin)) / self.spacing))
            for piece in range(1, pieces):
                found = nearest(begin + (end - begin) * piece / pieces)
                # a line that is tied more often than there are particles meets some of them again
                if found not in (route[-1], tied[k + 1]):
                    route.append(found)
            route.append(tied[k + 1])
        return np.array(route, np.int64)

    def problem(self, x: Array, dx: float) -> str | None:
        """Return what is wrong with a route along particles at x (r, D) in cells of dx, or None."""
        for point in self.route:
            gap = np.linalg.norm(x - np.array(point), axis=1)
            if gap.min() > dx:
                near, place = (", ".join(f"{c:.4g}" for c in of) for of in (x[np.argmin(gap)], point))
                return (
                    f"its point ({place}) is {gap.min():.3g} m from the body '{self.body}', whose nearest particle at "
                    f"rest is at ({near}): each point of a route lies within a cell ({dx:.3g} m) of a particle"
                )
        different = len(np.unique(x, axis=0))
        if different < 2:
            return "runs through fewer than two particles: lengthen the route"
        if different < len(x):
            return "runs through a particle twice: separate the points of the route, or tie it less often (`spacing`)"
        return None

    def constants(self, x: Array) -> Array:
        """Return nothing."""
        return np.zeros(0)

    def rest_length(self, x: Array) -> float:
        """Return the length [m] of a route along particles at x (r, D) [m]."""
        return float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum())

    def rest_length_vjp(self, x: Array, bar: float) -> Array:
        """Return the cotangent of x (r, D)."""
        gaps = np.diff(x, axis=0)
        along = bar * gaps / np.linalg.norm(gaps, axis=1, keepdims=True)
        ends = np.zeros((1, x.shape[1]))
        return np.asarray(np.concatenate([ends, along]) - np.concatenate([along, ends]))

    def stiffness_at_nodes(self, strength: float) -> float:
        """Return that of a node between two springs of the cable's stiffness [N/m]."""
        return 4.0 * strength


def make_kernel(actuators: Array, columns: list[Array], constants: list[Array]) -> Kernel:
    """Return the kernels' view of all cables."""
    return Kernel(*starts_of(columns), actuators)


@kernel
def segment(q: Array, p: int, r: int, in_3d: bool) -> tuple[float, float, float, float]:
    """Return the unit vector from particle p to particle r, and their distance [m]."""
    w = q.shape[2]
    x = q[r // w, 0, r % w] - q[p // w, 0, p % w]
    y = q[r // w, 1, r % w] - q[p // w, 1, p % w]
    z = q[r // w, 2, r % w] - q[p // w, 2, p % w] if in_3d else 0.0 * x
    length = np.sqrt(x * x + y * y + z * z)
    inverse = 1.0 / length if length > 0.0 else 0.0 * length
    return x * inverse, y * inverse, z * inverse, length


@kernel
def stretch(cables: Kernel, k: int, left: float, q: Array, in_3d: bool) -> float:
    """Return how far a cable is stretched beyond what is left of it [m]; negative where it is slack."""
    total = 0.0
    for i in range(cables.start[k], cables.start[k + 1] - 1):
        total += segment(q, cables.columns[i], cables.columns[i + 1], in_3d)[3]
    return total - left


@kernel
def reeled(u: float) -> float:
    """Return max(0, u)."""
    return 0.0 if u <= 0.0 else u


@kernel
def add_to(table: Array, p: int, x: float, y: float, z: float, in_3d: bool) -> None:
    """Add a vector to a particle's first rows of a packed table."""
    w = table.shape[2]
    table[p // w, 0, p % w] += x
    table[p // w, 1, p % w] += y
    if in_3d:
        table[p // w, 2, p % w] += z


@kernel
def pull(cables: Kernel, drive: Any, control: int, q: Array, fields: Array, force: Array) -> None:
    """Add the cables' forces."""
    in_3d = force.shape[1] == 3
    for k in range(len(cables.actuators)):
        a = cables.actuators[k]
        left = reeled(drive.activation[control, a]) * drive.rest[a]
        tension = drive.strength[a] * stretch(cables, k, left, q, in_3d)
        # what is not a number pulls too, so that it is found where it moves a particle
        if not tension <= 0.0:
            for i in range(cables.start[k], cables.start[k + 1] - 1):
                p, r = cables.columns[i], cables.columns[i + 1]
                x, y, z, _ = segment(q, p, r, in_3d)
                add_to(force, p, tension * x, tension * y, tension * z, in_3d)
                add_to(force, r, -tension * x, -tension * y, -tension * z, in_3d)


@kernel
def difference(force_bar: Array, p: int, r: int, in_3d: bool) -> tuple[float, float, float]:
    """Return the cotangent of the force on p less that of the force on r."""
    w = force_bar.shape[2]
    x = force_bar[p // w, 0, p % w] - force_bar[r // w, 0, r % w]
    y = force_bar[p // w, 1, p % w] - force_bar[r // w, 1, r % w]
    z = force_bar[p // w, 2, p % w] - force_bar[r // w, 2, r % w] if in_3d else 0.0 * x
    return x, y, z


@kernel
def pull_vjp(
    cables: Kernel, drive: Any, drive_bar: Any, control: int, q: Array, q_bar: Array, fields: Array, fields_bar: Array
) -> None:
    """Carry the cotangent of the forces back: through the tension, and through the segments' directions."""
    force_bar = drive_bar.push
    in_3d = force_bar.shape[1] == 3
    for k in range(len(cables.actuators)):
        a = cables.actuators[k]
        u, stiffness = drive.activation[control, a], drive.strength[a]
        s = stretch(cables, k, reeled(u) * drive.rest[a], q, in_3d)
        # one-sided at the kinks: just taut (s = 0) as if stretched; reeled in (u = 0) as for u > 0,
        # the only side within the limits
        if s >= 0.0:
            tension, tension_bar = stiffness * s, 0.0
            for i in range(cables.start[k], cables.start[k + 1] - 1):
                p, r = cables.columns[i], cables.columns[i + 1]
                x, y, z, _ = segment(q, p, r, in_3d)
                fx, fy, fz = difference(force_bar, p, r, in_3d)
                tension_bar += fx * x + fy * y + fz * z
            length_bar = stiffness * tension_bar
            drive_bar.strength[a] += s * tension_bar
            drive_bar.rest[a] -= reeled(u) * length_bar
            if u >= 0.0:
                drive_bar.activation[control, a] -= drive.rest[a] * length_bar
            for i in range(cables.start[k], cables.start[k + 1] - 1):
                p, r = cables.columns[i], cables.columns[i + 1]
                x, y, z, length = segment(q, p, r, in_3d)
                fx, fy, fz = difference(force_bar, p, r, in_3d)
                along = fx * x + fy * y + fz * z
                turn = tension / length if length > 0.0 else 0.0 * length
                dx = turn * (fx - along * x) + length_bar * x
                dy = turn * (fy - along * y) + length_bar * y
                dz = turn * (fz - along * z) + length_bar * z
                add_to(q_bar, r, dx, dy, dz, in_3d)
                add_to(q_bar, p, -dx, -dy, -dz, in_3d)


register_push(Kernel, make_kernel, pull, pull_vjp)

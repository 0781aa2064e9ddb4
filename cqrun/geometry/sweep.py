"""A disc that moves along a curve through points, in 2D a segment."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.spatial import cKDTree

from cqrun.explain import Loc, complaint, finding
from cqrun.geometry.shape import SLACK, Shape
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin

PER_RADIUS = 8
"""Straight pieces of the curve in the smallest radius."""

LEAST_PIECES, MOST_PIECES = 8, 20_000
"""Fewest straight pieces between two points, and most of the whole curve."""

PointOfCurve = Annotated[list[float], Field(min_length=2, max_length=3)]
Radius = Annotated[float, Field(gt=0)]


@plugin("shape", "sweep")
class Sweep(Shape):
    """A disc (2D: a segment) that moves along a curve and stays perpendicular to it: a tentacle, or a bent finger.

    The curve passes through `points`. `smooth` is a centripetal Catmull-Rom spline. Its radius changes smoothly, and
    stays between the radii of the two points around. `straight` joins the points by straight lines, with round joints.
    The ends are flat; for a round tip, make a `union` with a ball. A hollow one is a `difference` of two sweeps. Where
    the curve comes near itself, the nearest point of the curve decides. Particles do not follow the numbers of a sweep,
    so these cannot be unknowns.
    """

    points: list[PointOfCurve] = quantity("m", "Points of the curve in order", min_length=2)
    radii: list[Radius] = quantity("m", "Radius at each point, or one for all (2D: half the width)", min_length=1)
    curve: Literal["smooth", "straight"] = Field(description="How the curve joins the points", default="smooth")

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [
            (("points", k), f"must have {dim} entries in this {dim}D world, has {len(point)}")
            for k, point in enumerate(self.points)
            if len(point) != dim
        ]

    @model_validator(mode="after")
    def _is_a_curve(self) -> Self:
        for k, point in enumerate(self.points[1:], 1):
            if len(point) != len(self.points[0]):
                raise complaint(self.name, [finding("must have as many entries as the first point", ("points", k))])
            if point == self.points[k - 1]:
                raise complaint(self.name, [finding("must differ from the point before it", ("points", k))])
        if len(self.radii) not in (1, len(self.points)):
            message = (
                f"must be one for all, or one for each of the {len(self.points)} points; there are {len(self.radii)}"
            )
            raise complaint(self.name, [finding(message, ("radii",), involves=("points",))])
        return self

    def inside(self, points: Array) -> Array:
        lower, upper = self.bounds()
        near = np.flatnonzero(((points >= lower) & (points <= upper)).all(axis=1))
        result = np.zeros(len(points), bool)
        result[near] = self._line().contains(points[near])
        return result

    def bounds(self) -> tuple[Array, Array]:
        return self._line().bounds()

    def _line(self) -> _Line:
        radii = self.radii * len(self.points) if len(self.radii) == 1 else self.radii
        return _line_through(tuple(map(tuple, self.points)), tuple(radii), self.curve == "smooth")


class _Line(NamedTuple):
    """A curve as many straight pieces.

    Attributes:
        x: corners (n, D) [m].
        radius: at each corner (n,) [m].
        tree: of the corners.
    """

    x: Array
    radius: Array
    tree: cKDTree

    def contains(self, points: Array) -> Array:
        """Return which points (N, D) are within the radius of the nearest point of the curve, and not beyond an end."""
        longest = np.linalg.norm(np.diff(self.x, axis=0), axis=1).max()
        reach = 1.01 * np.hypot(self.radius.max(), longest)
        far, corner = self.tree.query(points, distance_upper_bound=reach)
        result = np.isfinite(far)
        result[result] = self._contains(points[result], corner[result])
        return result

    def _contains(self, points: Array, corner: Array) -> Array:
        """Return the same if the nearest corner of each point is known (N,)."""
        nearest, result = np.full(len(points), np.inf), np.zeros(len(points), bool)
        last = len(self.x) - 2
        for piece in (np.maximum(corner - 1, 0), np.minimum(corner, last)):  # the nearest point is beside the corner
            start, along = self.x[piece], self.x[piece + 1] - self.x[piece]
            square = np.einsum("nd,nd->n", along, along)
            share = np.einsum("nd,nd->n", points - start, along) / square
            slack = SLACK * len(self.x)
            beyond = ((piece == 0) & (share < -slack)) | ((piece == last) & (share > 1 + slack))
            share = np.clip(share, 0.0, 1.0)
            distance = np.linalg.norm(points - start - share[:, None] * along, axis=1)
            radius = self.radius[piece] + share * (self.radius[piece + 1] - self.radius[piece])
            result = np.where(distance < nearest, (distance <= radius * (1 + SLACK)) & ~beyond, result)
            nearest = np.minimum(nearest, distance)
        return result

    def bounds(self) -> tuple[Array, Array]:
        """Return the bounds (D,) [m] of the discs, and of the joints between them."""
        along = np.diff(self.x, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        before, after = np.concatenate([along[:1], along]), np.concatenate([along, along[-1:]])
        # a disc across d reaches r sqrt(1 - d_i^2) along axis i; a joint reaches r if the axis lies between its discs
        disc = np.sqrt(np.maximum(1 - np.minimum(before**2, after**2), 0))
        up, down = ((sign * before >= 0) & (sign * after <= 0) for sign in (1, -1))
        radius = self.radius[:, None]
        lower, upper = (self.x + sign * radius * np.where(joint, 1.0, disc) for sign, joint in ((-1, down), (1, up)))
        return lower.min(axis=0), upper.max(axis=0)


@lru_cache(maxsize=32)
def _line_through(points: tuple[tuple[float, ...], ...], radii: tuple[float, ...], smooth: bool) -> _Line:
    """Return the curve through points [m] with radii [m] as straight pieces."""
    x, r = np.array(points), np.array(radii)
    lengths = np.linalg.norm(np.diff(x, axis=0), axis=1)
    pieces = np.ceil(PER_RADIUS * lengths / r.min())
    pieces = np.clip(pieces, LEAST_PIECES, max(LEAST_PIECES, MOST_PIECES // len(lengths))).astype(int)
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(lengths) if smooth else lengths)])
    parts = [a + (b - a) * np.arange(n) / n for a, b, n in zip(knots[:-1], knots[1:], pieces, strict=True)]
    t = np.concatenate([*parts, knots[-1:]])
    if smooth and len(x) > 2:
        at, radius = CubicHermiteSpline(knots, x, _slopes(knots, x))(t), PchipInterpolator(knots, r)(t)
    else:
        at, radius = np.stack([np.interp(t, knots, axis) for axis in x.T], axis=1), np.interp(t, knots, r)
    return _Line(at, radius, cKDTree(at))


def _slopes(knots: Array, x: Array) -> Array:
    """Return the derivatives (n, D) of a Catmull-Rom spline at its points: those of parabolas through three of them."""
    step = np.diff(knots)[:, None]
    chord = np.diff(x, axis=0) / step
    inner = (step[1:] * chord[:-1] + step[:-1] * chord[1:]) / (step[:-1] + step[1:])
    return np.concatenate([2 * chord[:1] - inner[:1], inner, 2 * chord[-1:] - inner[-1:]])

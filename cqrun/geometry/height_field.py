"""Terrain: all points below a height over x."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.boundaries.solid import HILLS, POLYGON, TERRAIN, Solid
from cqrun.errors import UsageError
from cqrun.explain import Loc, complaint, finding
from cqrun.geometry.shape import Shape, slack_at
from cqrun.plugin.contract import Array, Spec, quantity
from cqrun.plugin.registry import plugin

Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


class Sinusoid(Spec):
    """Hills: h = base + amplitude sin(2 pi x / wavelength + phase)."""

    amplitude: float = quantity("m", "Half the height from valley to crest", gt=0, geometric=True)
    wavelength: float = quantity("m", "Distance from crest to crest", gt=0, geometric=True)
    base: float = quantity("m", "Height in the middle", geometric=True)
    phase: float = quantity("deg", "Phase at x = 0", geometric=True, default=0.0)


@plugin("shape", "height_field")
class HeightField(Shape):
    """All points below a height h(x): terrain, as a body of particles or as the region of a boundary.

    The height is interpolated linearly between `points` and constant beyond the ends, or it is a sinusoid. In 3D it
    does not change along the third axis. A body needs `span` and `bottom`; a boundary does not.
    """

    points: list[Pair] | None = quantity("m", "Profile: [x, height] each, x increasing", min_length=2, default=None)
    sinusoid: Sinusoid | None = Field(description="Profile of hills instead of points", default=None)
    span: Pair | None = quantity("m", "Range of x that it covers; infinite if absent", default=None)
    bottom: float | None = quantity("m", "Height of its lower side; infinite if absent", geometric=True, default=None)
    up: Literal["y", "z"] | None = Field(description="Axis of the height in 3D; y in 2D", default=None)

    @model_validator(mode="after")
    def _is_a_profile(self) -> Self:
        problems = []
        if (self.points is None) == (self.sinusoid is None):
            problems.append(finding("must have exactly one of points, sinusoid", involves=("points", "sinusoid")))
        if self.points is not None and (np.diff(np.array(self.points)[:, 0]) <= 0).any():
            problems.append(finding("must go from left to right: every x greater than the previous one", ("points",)))
        if self.span is not None and not self.span[0] < self.span[1]:
            problems.append(finding(f"must begin before it ends, is {self.span}", ("span",)))
        if problems:
            raise complaint(self.name, problems)
        if self.bottom is not None and self.bottom >= self._highest():
            message = f"must be below the highest point, {self._highest():.6g} m, is {self.bottom:g}"
            raise complaint(self.name, [finding(message, ("bottom",))])
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        if dim == 3 and self.up is None:
            return [(("up",), "is missing: in a 3D world say whether heights are along y or z")]
        if dim == 2 and self.up is not None:
            return [(("up",), "is for a 3D world; in 2D heights are along y")]
        return []

    def height(self, x: Array) -> Array:
        """Return h [m] at x (N,) [m]."""
        if self.points is not None:
            return np.asarray(np.interp(x, *np.array(self.points).T))
        hills = self._hills
        angle = 2 * np.pi * x / hills.wavelength + hills.phase * (np.pi / 180)
        return np.asarray(hills.base + hills.amplitude * np.sin(angle))

    def normals(self, points: Array) -> Array:
        """Return the unit normal (N, D) of the terrain below or above points (N, D): (-h', 1) / sqrt(1 + h'^2)."""
        slope = self._slope(points[:, 0])
        normal = np.zeros(points.shape)
        normal[:, 0], normal[:, self._axis] = -slope, 1.0
        return normal / np.sqrt(1 + slope**2)[:, None]

    def inside(self, points: Array) -> Array:
        x, height, slack = points[:, 0], points[:, self._axis], slack_at(points)
        result = height <= self.height(x) + slack
        if self.span is not None:
            result &= (x >= self.span[0] - slack) & (x <= self.span[1] + slack)
        return result if self.bottom is None else result & (height >= self.bottom - slack)

    def bounds(self) -> tuple[Array, Array]:
        dim = 2 if self.up is None else 3
        lower, upper = np.full(dim, -np.inf), np.full(dim, np.inf)
        if self.span is not None:
            lower[0], upper[0] = self.span
        if self.bottom is not None:
            lower[self._axis] = self.bottom
        upper[self._axis] = self._highest()
        return lower, upper

    def solids(self) -> list[Solid]:
        axes = np.eye(2 if self.up is None else 3)
        origin, plane = np.zeros((1, len(axes))), axes[[0, self._axis]]
        if self.points is None:
            if self.span is not None or self.bottom is not None:
                raise UsageError("the distance from a sinusoid with `span` or `bottom` is not known; give `points`")
            hills = self._hills
            wave = [hills.amplitude, hills.wavelength, hills.base, np.deg2rad(hills.phase)]
            return [Solid(HILLS, origin, plane, np.array(wave))]
        if self.span is None and self.bottom is None:
            return [Solid(TERRAIN, origin, plane, np.array(self.points, float).ravel())]
        if self.span is None or self.bottom is None:
            raise UsageError("the distance from a height field is known with both of `span` and `bottom`, or neither")
        x = np.array(self.points, float)[:, 0]
        x = np.concatenate([self.span[:1], x[(x > self.span[0]) & (x < self.span[1])], self.span[1:]])
        top = np.stack([x, self.height(x)], axis=1)
        below = [[self.span[1], self.bottom], [self.span[0], self.bottom]]
        return [Solid(POLYGON, origin, plane, np.concatenate([top, below]).ravel())]

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        """Stretch every vertical column between the bottom and the height."""
        height, bottom, bottom_to = self.height(points[:, 0]), self._depth, to._depth
        stretch = (to.height(points[:, 0]) - bottom_to) / (height - bottom)
        moved = points.astype(stretch.dtype)
        moved[:, self._axis] = bottom_to + (points[:, self._axis] - bottom) * stretch
        return moved, stretch

    @property
    def _depth(self) -> float:
        assert self.bottom is not None, "a body has a bottom"
        return self.bottom

    @property
    def _axis(self) -> int:
        return 2 if self.up == "z" else 1

    @property
    def _hills(self) -> Sinusoid:
        assert self.sinusoid is not None, "a profile has points or a sinusoid"
        return self.sinusoid

    def _slope(self, x: Array) -> Array:
        """Return dh/dx at x (N,); at a corner of the profile, the slope of the segment on its right."""
        if self.points is None:
            hills = self._hills
            angle = 2 * np.pi * x / hills.wavelength + np.deg2rad(hills.phase)
            return np.asarray(2 * np.pi * hills.amplitude / hills.wavelength * np.cos(angle))
        corners, heights = np.array(self.points).T
        slopes = np.concatenate([[0.0], np.diff(heights) / np.diff(corners), [0.0]])  # constant beyond the ends
        return np.asarray(slopes[np.searchsorted(corners, x, side="right")])

    def _highest(self) -> float:
        """Return the largest height within the span."""
        if self.points is not None:
            candidates = np.array(self.points)[:, 0]
        elif self.span is not None:
            hills = self._hills
            first = (0.25 - hills.phase / 360) * hills.wavelength  # a crest
            count = np.floor((self.span[1] - first) / hills.wavelength)
            candidates = np.array([first + count * hills.wavelength])
        else:
            return self._hills.base + self._hills.amplitude
        if self.span is not None:
            candidates = np.append(candidates[(candidates >= self.span[0]) & (candidates <= self.span[1])], self.span)
        return float(self.height(candidates).max())

"""A guide that winds around an axis."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import model_validator

from cqrun.explain import Loc, complaint, finding
from cqrun.forces.route import Point
from cqrun.plugin.contract import Array, Spec, quantity

EACH_TURN = 24
"""Points in a turn, if no spacing is given: the chords are 0.3 % shorter than the arcs."""


class Helix(Spec):
    """A helix around an axis, from a point on; its radius may change along the axis.

    It ends beside the end of the axis. Seen along the axis, from its start to its end, positive turns are clockwise.
    """

    axis: list[Point] = quantity("m", "Start and end of the axis at rest", min_length=2, max_length=2)
    begin: list[float] = quantity("m", "First point of the helix", min_length=3, max_length=3)
    turns: float | None = quantity("1", "Number of turns, negative for the other way; or give `pitch`", default=None)
    pitch: float | None = quantity(
        "m", "Way along the axis in a turn, negative for the other way; or give `turns`", default=None
    )
    end_radius: float | None = quantity(
        "m", "Distance of the last point from the axis; that of the first point if absent", ge=0, default=None
    )

    @model_validator(mode="after")
    def _wound_once(self) -> Self:
        if (self.turns is None) == (self.pitch is None) or self.pitch == 0.0:
            has = "neither" if self.turns is None and self.pitch is None else "both"
            has = "a pitch of 0" if self.pitch == 0.0 else has
            message = f"needs exactly one of `turns` and `pitch`, which must not be 0; has {has}"
            raise complaint("Helix", [finding(message, involves=("turns", "pitch"))])
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        if dim != 3:
            return [((), f"a helix needs a 3D world, this one is {dim}D: give a `route`")]
        if any(len(point) != 3 for point in self.axis):
            return [(("axis",), "must have two points with 3 entries each")]
        along, radius = self._along(), self._first()[1]
        if not np.any(along):
            return [(("axis",), "must have two different points")]
        if radius == 0.0:
            return [(("begin",), "must not lie on the axis")]
        return []

    def points(self, spacing: float | None) -> Array:
        """Return the points of the helix (r, 3) [m], `spacing` apart, or `EACH_TURN` in a turn."""
        along = self._along()
        height = float(np.linalg.norm(along))
        n = along / height
        below, radius = self._first()
        way = height - below
        turns = way / self.pitch if self.turns is None else self.turns  # type: ignore[operator]
        last = radius if self.end_radius is None else self.end_radius
        a = (np.array(self.begin) - np.array(self.axis[0]) - below * n) / radius
        b = np.cross(n, a)
        length = float(np.hypot(way, 2.0 * np.pi * turns * max(radius, last)))
        count = max(1, round(EACH_TURN * abs(turns) if spacing is None else length / spacing))
        part = np.arange(count + 1)[:, None] / count
        angle, size = 2.0 * np.pi * turns * part, radius + (last - radius) * part
        on_axis = np.array(self.axis[0]) + (below + way * part) * n
        return np.asarray(on_axis + size * (np.cos(angle) * a + np.sin(angle) * b))

    def _along(self) -> Array:
        return np.array(self.axis[1]) - np.array(self.axis[0])

    def _first(self) -> tuple[float, float]:
        """Return how far along the axis the first point is, and its distance from it [m]."""
        along, first = self._along(), np.array(self.begin) - np.array(self.axis[0])
        n = along / max(float(np.linalg.norm(along)), 1e-300)
        return float(first @ n), float(np.linalg.norm(first - (first @ n) * n))

"""Check that obstacles of the reference frame are thick enough to stop a body.

A point of a surface that is deeper in an obstacle than half its thickness is pushed out on the other side. And points
of a surface are half a cell apart, so that what is small in all directions passes between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cqrun.boundaries.solid import BOX, CAPSULE, CONE, MESH, POLYGON, TAPER, Solid, make_solids, signed_distance
from cqrun.build.regions import boundary
from cqrun.errors import Problem
from cqrun.geometry.mesh_tree import mesh_triangles
from cqrun.scene.schema import Scene

PLATE, DOT = 0.5, 1.5
"""Smallest thickness of an obstacle, and of one that is as thin in all directions [cells]. A disc of 5 cells of radius
that falls at 1 m/s, on E = 100 kPa, passes through a plate of 0.1 cells and a ball of 1 cell."""


def obstacle_warnings(scene: Scene) -> Iterator[Problem]:
    """Yield a warning for each obstacle of the reference frame that a body may pass through."""
    for name in scene.boundaries if scene.world.frame == "reference" else ():
        spec: Any = boundary(scene, name)
        if not spec.is_obstacle or spec.region is None:
            continue
        solids, dx = list(spec.region.value.solids()), scene.world.dx
        for k, solid in enumerate(solids):
            thickness, longest = _extent(solid)
            least = (DOT if longest < DOT * dx else PLATE) * dx
            if thickness < least * (1 - 1e-9) and not _backed(solid, thickness, solids[:k] + solids[k + 1 :]):
                path = f"boundaries.{name}.{spec.name}.region"
                message = (
                    f"is {thickness:.3g} m thick, {thickness / dx:.2g} cells: bodies may pass through it; make it "
                    f"{least:.3g} m thick, or dx smaller"
                )
                yield Problem(scene.where(path), path, message)
                break


def _extent(solid: Solid) -> tuple[float, float]:
    """Return the smallest and the largest extent of a solid [m]; both infinite if it has none."""
    lengths = solid.lengths
    if solid.kind == BOX:
        return 2.0 * float(lengths.min()), 2.0 * float(lengths.max())
    if solid.kind in (CAPSULE, TAPER, CONE):
        along = float(np.linalg.norm(solid.points[1] - solid.points[0]))
        across = 2.0 * float(lengths.max())
        if solid.kind == CONE:
            return min(along, across), max(along, across)
        return across, along + across
    if solid.kind == POLYGON:  # a strip's thickness is twice its area over its circumference
        corners = lengths.reshape(-1, 2)
        edges = np.roll(corners, -1, axis=0) - corners
        area = 0.5 * abs(float(np.sum(corners[:, 0] * edges[:, 1] - corners[:, 1] * edges[:, 0])))
        return 2.0 * area / float(np.linalg.norm(edges, axis=1).sum()), float(np.ptp(corners, axis=0).max())
    if solid.kind == MESH:  # and a plate's twice its volume over its surface
        corners = mesh_triangles(solid)
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        volume = float(np.linalg.det(corners - corners[0, 0]).sum()) / 6.0
        return 2.0 * volume / float(area.sum()), float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    return np.inf, np.inf


def _backed(solid: Solid, thickness: float, others: Sequence[Solid]) -> bool:
    """Return whether the middle of a solid lies in another one, or on it."""
    if not others:
        return False
    dim = solid.points.shape[1]
    middle = solid.points.mean(axis=0)
    if solid.kind == MESH:
        middle = mesh_triangles(solid).mean(axis=(0, 1))
    if solid.kind == POLYGON:
        middle = solid.points[0] + solid.lengths.reshape(-1, 2).mean(axis=0) @ solid.directions
    table, x = make_solids(others), tuple(np.pad(middle, (0, 3 - dim)))
    return bool(min(signed_distance(table, k, x)[0] for k in range(len(others))) < thickness)

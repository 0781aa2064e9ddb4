"""Where the grid of each body lies: with a row of nodes on the flat faces of what holds it.

A boundary holds nodes. If its face lies between two rows, it ends up to a cell too early, and what is free is longer by
that: with 26 cells of free length, a modulus that is fitted to a bending beam is up to 12 % too large. In the reference
frame each body has a grid of its own, so its grid is shifted by at most half a cell. A second face along the same axis
fits only if their distance is a multiple of the spacing; else there is a warning, and in the updated frame there is one
before a fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cqrun.boundaries.condition import FACES
from cqrun.build.particles import Particles
from cqrun.build.regions import resolved
from cqrun.engine.lattice import Lattice
from cqrun.errors import Problem
from cqrun.geometry.box import Box
from cqrun.geometry.combinations import RegionUnion
from cqrun.geometry.half_space import HalfSpace
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

HOLDS = ("sticky", "slip")
"""The boundaries that hold a body's own nodes."""

EXACT = 1e-6
"""Distance of a face from a row of nodes below which it lies on it [cells]."""

OFF = 0.02
"""Distance from which a user is told [cells]."""


class HeldFace(NamedTuple):
    """A flat face of a boundary that ends within a body."""

    boundary: str
    axis: int
    at: float  # [m]
    side: int  # on which the body is free: 1 above the face, -1 below


def grid_offset(scene: Scene, particles: Particles) -> Array | None:
    """Return the offset of each body's grid from that of the world (B, D) [m]; None in the updated frame."""
    if scene.world.frame != "reference":
        return None
    if "offset" not in particles.found:
        found = particles.found["offset"] = np.zeros((len(particles.names), scene.dim))
        for k, name in enumerate(particles.names):
            for face in reversed(held_faces(scene, particles, name)):  # the first of an axis counts
                found[k, face.axis] = _beside_node(face.at, scene.world.dx)
    offset: Array = particles.found["offset"]
    return offset


def lattice_of(scene: Scene, particles: Particles) -> Lattice | None:
    """Return the lattices of the particles; None in the updated frame, which knows no neighbours."""
    if scene.world.frame != "reference":
        return None
    spacing = [scene.bodies[name].lattice_spacing(scene.world.dx) or 0.0 for name in particles.names]
    return Lattice(particles.x, np.array(spacing))


def _beside_node(at: float, dx: float) -> float:
    """Return the distance of a place from the nearest row of nodes [m]."""
    distance = at - round(at / dx) * dx
    return distance if abs(distance) > EXACT * dx else 0.0


def held_faces(scene: Scene, particles: Particles, body: str) -> list[HeldFace]:
    """Return the flat faces that end within a body, at rest, in the order of the boundaries."""
    x, spacing, faces = particles.x[particles.of(body)], particles.spacing[body], []
    for name, chosen in scene.boundaries.items():
        for lower, upper in _boxes(scene, chosen.value) if chosen.name in HOLDS else ():
            near = (x >= lower - spacing) & (x <= upper + spacing)
            for axis in range(scene.dim):
                beside = x[np.delete(near, axis, axis=1).all(axis=1), axis]
                faces += [
                    HeldFace(name, axis, float(at), side)
                    for at, side in ((lower[axis], -1), (upper[axis], 1))
                    if _ends_within(beside, float(at), side, spacing)
                ]
    return faces


def _ends_within(x: Array, at: float, side: int, spacing: float) -> bool:
    """Return whether particles at x (n,) [m] lie on the free side of a face, and others at it or behind it."""
    ahead = side * (x - at)
    return bool(np.isfinite(at) and len(x) and ahead.max() > 0.25 * spacing and ahead.min() < spacing)


def _boxes(scene: Scene, spec: Any) -> Iterator[tuple[Array, Array]]:
    """Yield the corners of the axis-aligned boxes of which a boundary consists; half-spaces have infinite ones."""
    if spec.region is not None:
        yield from _boxes_of(scene, spec.region)
        return
    size = np.array(scene.world.size)
    for face in FACES[: 2 * scene.dim] if spec.face == "all" else (str(spec.face),):
        lower, upper, axis = np.full(scene.dim, -np.inf), np.full(scene.dim, np.inf), "xyz".index(face[0])
        if face.endswith("min"):
            upper[axis] = spec.thickness
        else:
            lower[axis] = size[axis] - spec.thickness
        yield lower, upper


def _boxes_of(scene: Scene, chosen: Chosen[Any]) -> Iterator[tuple[Array, Array]]:
    region = resolved(scene, chosen).value
    if isinstance(region, Box) or (isinstance(region, HalfSpace) and np.count_nonzero(region.normal) == 1):
        yield region.bounds()
    elif isinstance(region, RegionUnion):
        for part in region.shapes:
            yield from _boxes_of(scene, part)


def alignment_warnings(scene: Scene, particles: Particles) -> Iterator[Problem]:
    """Yield warnings about faces that end between rows of nodes; in the updated frame, where a material is fitted."""
    dx, offset = scene.world.dx, grid_offset(scene, particles)
    if offset is None and scene.job != "sysid":
        return
    for k, name in enumerate(particles.names):
        faces = held_faces(scene, particles, name)
        for face in faces:
            own = 0.0 if offset is None else float(offset[k, face.axis])
            short = face.side * (face.at - own) % dx  # from the last row that is held to the face
            if not OFF * dx < short < (1.0 - OFF) * dx:
                continue
            axis, path = "xyz"[face.axis], f"boundaries.{face.boundary}.{scene.boundaries[face.boundary].name}"
            first = next(each for each in faces if each.axis == face.axis)
            base = 0.0 if offset is None else first.at
            distance = abs(face.at - base)
            message = (
                f"ends at {axis} = {face.at:.6g} m between two rows of nodes, so it holds '{name}' only to "
                f"{axis} = {face.at - face.side * short:.6g} m, and {short:.3g} m more of it are free: set a dx that "
                f"divides {distance:.6g} m, such as {distance / np.ceil(distance / dx):.6g}"
            )
            yield Problem(scene.where(path), path, message)

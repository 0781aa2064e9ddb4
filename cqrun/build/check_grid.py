"""Check what the grid cannot resolve: bodies, gaps and boundaries that are too thin, or that start in each other.

A particle exchanges momentum with 3 nodes along each axis, and midway between two rows only with these two. So two rows
of held nodes stop it, but one does not. The material on both sides of a narrow gap sticks together, and a thin body
bends too far. A scene may still be useful: these are warnings, with the size needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy import ndimage

from cqrun.boundaries.sticky import Sticky
from cqrun.build.check_clamps import clamp_warnings
from cqrun.build.check_gaps import TOO_CLOSE
from cqrun.build.check_holds import hold_warnings
from cqrun.build.check_moves import moving_warnings
from cqrun.build.check_obstacles import obstacle_warnings
from cqrun.build.particles import Particles
from cqrun.build.raster import THIN, Raster, across, depth, membrane, neck, thinner
from cqrun.engine.model import ConditionModel
from cqrun.engine.reference.split import REACH
from cqrun.engine.setting import MARGIN, grid_shape
from cqrun.errors import Problem
from cqrun.geometry.place import Place
from cqrun.plugin.contract import Array
from cqrun.scene.body import Body
from cqrun.scene.schema import Scene

ROWS = 2
"""Smallest number of rows of nodes that no body passes through."""

CELLS = 3
"""Smallest number of cells through the thickness of a body; with 1, 2 and 3 a beam sags 32, 10 and 6 % too far."""

OPEN = 3
"""From this width a gap opens nearly freely in a body of the reference frame without a lattice [cells]."""

GLUED = "the material around it sticks together as if glued"
STIFF = "both sides share nodes, so one of 2 cells opens by a tenth of what it should, one of 3 cells by nine tenths"
CLOSED = "no layer of particles may be missing there, and then the material around it sticks together as if glued"


def grid_warnings(
    scene: Scene, particles: Particles, conditions: Sequence[ConditionModel], rasters: Mapping[str, Raster]
) -> list[Problem]:
    """Return warnings about everything that the grid cannot resolve; `rasters` has the bodies by name."""
    shape = grid_shape(np.array(scene.world.size), scene.world.dx)
    return [
        *_bodies(scene, rasters),
        *_boundaries(scene, conditions),
        *clamp_warnings(scene, particles, conditions, nearest_nodes(particles.x, shape, scene.world.dx)),
        *_starts_inside(scene, particles, conditions),
        *hold_warnings(scene, particles, conditions),
        *moving_warnings(scene, particles),
        *obstacle_warnings(scene),
    ]


# --- bodies and the gaps in them --------------------------------------------------------------------------------------


def _bodies(scene: Scene, rasters: Mapping[str, Raster]) -> Iterator[Problem]:
    """Yield warnings about bodies less than 3 cells thick, their necks of less than 2, and narrow gaps in them."""
    dx = scene.world.dx
    for name, body in scene.bodies.items():
        path = f"bodies.{name}." + ("shape" if body.shape else "parts")
        solid, corner, pitch = rasters[name].solid, rasters[name].corner, rasters[name].pitch
        depths = depth(solid)
        thin = thinner(solid, CELLS * dx / pitch, depths)
        if thin.sum() > THIN * solid.sum():
            layers, cell = across(solid, depths, thin)
            thickness, at = pitch * layers, _place(body, corner, pitch, cell)
            cells = f"{thickness / dx:.2g}"
            message = (
                f"is {cells} {'cell' if cells == '1' else 'cells'} thick at {at}: a beam of 1 cell sags about 30 % too "
                f"far, one of 2 cells 10 %; set dx to {thickness / CELLS:.3g} m, or make it {CELLS * dx:.3g} m thick"
            )
            yield Problem(scene.where(path), path, message)
        elif (narrow := neck(solid, ROWS * dx / pitch, depths)).any():
            at = _place(body, corner, pitch, np.argwhere(narrow)[0])
            message = (
                f"has a neck less than {ROWS} cells thick at {at}, which joins thicker parts: it bends too easily, and "
                f"may break; make it {CELLS * dx:.3g} m thick, or dx smaller"
            )
            yield Problem(scene.where(path), path, message)
        elif (wall := membrane(solid, ROWS * dx / pitch, depths)).any():
            at = _place(body, corner, pitch, across(solid, depths, wall)[1])
            message = (
                f"has a wall less than {ROWS} cells thick at {at}, between a cavity and the outside or another cavity: "
                f"it gives way too easily; make it {CELLS * dx:.3g} m thick, or dx smaller"
            )
            yield Problem(scene.where(path), path, message)
        yield from _gaps(scene, body, path, rasters[name])


def _gaps(scene: Scene, body: Body, path: str, raster: Raster) -> Iterator[Problem]:
    """Yield a warning about a gap or a hole in a body that is narrow for the grid."""
    dx, pitch = scene.world.dx, raster.pitch
    told = _told_of_gaps(scene, body)
    border = int(np.ceil(CELLS * dx / pitch))
    space = ~np.pad(raster.solid, border)
    for width, what in told.items():
        gaps = thinner(space, width * dx / pitch)
        if gaps.sum() * pitch**scene.dim > (width * dx) ** scene.dim:
            at = _place(body, raster.corner - border * pitch, pitch, np.argwhere(gaps)[0])
            message = (
                f"has a gap or a hole at {at} that is less than {width:.3g} cells wide: {what}; "
                f"if it should open freely, make it {max(told) * dx:.3g} m wide, or dx smaller"
            )
            yield Problem(scene.where(path), path, message)
            return


def _told_of_gaps(scene: Scene, body: Body) -> dict[float, str]:
    """Return what gaps do that are narrower than a width [cells], from the narrowest on.

    On one lattice in the reference frame, each side of a gap has nodes of its own (engine/reference/split.py).
    """
    if scene.world.frame == "updated":
        return {TOO_CLOSE: GLUED}
    spacing = body.lattice_spacing(scene.world.dx)
    return {TOO_CLOSE: GLUED, OPEN: STIFF} if spacing is None else {REACH * spacing / scene.world.dx: CLOSED}


def _place(body: Body, corner: Array, pitch: float, cell: Array) -> str:
    """Return the position in the world of a cell (D,) of a raster, as text."""
    place = body.place or Place()
    x = corner + (cell + 0.5) * pitch
    return _point(place.to_world(x[None] / place.scale)[0])


# --- boundaries -------------------------------------------------------------------------------------------------------


def _boundaries(scene: Scene, conditions: Sequence[ConditionModel]) -> Iterator[Problem]:
    """Yield warnings about regions of a single row of nodes, which bodies pass through."""
    dx = scene.world.dx
    for condition in conditions:
        if condition.spec.region is None:
            continue
        nodes = _in_world(scene, condition.nodes)
        thin = _single_rows(nodes)
        if thin.sum() > ROWS or (thin.any() and (thin == nodes).all()):
            path = f"boundaries.{condition.name}.{condition.spec.name}.region"
            message = (
                f"is a single row of nodes at {_point(np.argwhere(thin)[0] * dx)}, which bodies pass through: make it "
                f"{ROWS * dx:.3g} m thick, or {(ROWS - 1) * dx:.3g} m with its faces on nodes"
            )
            yield Problem(scene.where(path), path, message)


def _single_rows(nodes: Array) -> Array:
    """Return which held nodes of the world have no second row next to them; tips of thicker parts do not count.

    A boundary at a face of the world continues beyond it, because nothing comes from there.
    """
    held = np.pad(nodes, ROWS, mode="edge")
    thick = ndimage.binary_opening(held, np.ones((ROWS,) * held.ndim))
    near = ndimage.binary_dilation(thick, np.ones((3,) * held.ndim))
    return np.asarray((held & ~near)[(slice(ROWS, -ROWS),) * held.ndim])


def _in_world(scene: Scene, nodes: Array) -> Array:
    """Return the part of an array over all nodes (n,) that lies in the world, with one axis per dimension."""
    size = np.array(scene.world.size)
    counts = np.floor(size / scene.world.dx + 1e-9).astype(int) + 1
    inner = tuple(slice(MARGIN, MARGIN + int(count)) for count in counts)
    return np.asarray(nodes.reshape(grid_shape(size, scene.world.dx))[inner])


def _starts_inside(scene: Scene, particles: Particles, conditions: Sequence[ConditionModel]) -> Iterator[Problem]:
    """Yield warnings about particles that start inside a boundary that is no clamp; no substep would bring them there.

    Particles on its surface have its first row of nodes as their nearest ones.
    """
    dx = scene.world.dx
    shape = grid_shape(np.array(scene.world.size), dx)
    nodes = nearest_nodes(particles.x, shape, dx)
    inside: dict[str, Array] = {}
    for condition in conditions:
        if not isinstance(condition.spec, Sticky) and condition.nodes[nodes].any():
            deep = ndimage.binary_erosion(condition.nodes.reshape(shape), np.ones((3,) * scene.dim), border_value=1)
            path = f"boundaries.{condition.name}.{condition.spec.name}"
            inside[path] = inside.get(path, False) | deep.reshape(-1)[nodes]
    for path, which in inside.items():
        if which.any():
            first = int(np.argmax(which))
            message = (
                f"{int(which.sum()):,} particles start inside it, such as one of '{_body_of(particles, first)}' at "
                f"{_point(particles.x[first])}: there a body does not move freely; move it out, or clamp it with sticky"
            )
            yield Problem(scene.where(path), path, message)


def _body_of(particles: Particles, number: int) -> str:
    """Return the name of a particle's body."""
    return next(name for name in particles.names if number < particles.of(name).stop)


def nearest_nodes(x: Array, shape: tuple[int, ...], dx: float) -> Array:
    """Return the index of the nearest node of a grid for each particle at x (N, D) [m]."""
    return np.asarray(np.ravel_multi_index(tuple((np.round(x / dx).astype(int) + MARGIN).T), shape))


def _point(x: Array) -> str:
    return "(" + ", ".join(f"{c + 0.0:.4g}" for c in x) + ") m"

"""Rigid bodies in pictures: the outlines of their solids in the plane of a view, at the place of a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from cqrun.boundaries.solid import BOX, CAPSULE, CONE, MESH, POLYGON, Solid
from cqrun.figures.style import GREY
from cqrun.figures.views import View
from cqrun.geometry.mesh_tree import mesh_triangles
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene
from cqrun.store.rigid_motion import RigidMotions, columns_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection

ROUND = 48
"""Points of a circle."""

PIXELS, RIM = 300, 2
"""Of the image in which the outline of a mesh is found: along its longer side, and around it."""

FACE, OPACITY = "#B8C4CE", 0.55
"""Colour of rigid bodies; soft bodies behind them shine through."""


def outlines(scene: Scene, motions: RigidMotions | None, step: int, look: View) -> list[Array]:
    """Return a polygon (k, 2) [m] in the plane of a view for each bounded solid of each rigid body; of a mesh, some.

    Args:
        scene: the scene.
        motions: of its rigid bodies; None for their places at rest.
        step: the control step.
        look: the view.
    """
    found = []
    for name, body in scene.rigid.items():
        for solid in body.shape.value.solids():
            x = corners_of(solid)
            if motions is not None and name in motions.rows:
                row = motions.rows[name][min(step, len(motions.time) - 1)]
                x = placed(x, row, motions.center[name])
            plane = x @ look.axes.T
            if solid.kind == MESH:
                found += silhouette(plane.reshape(-1, 3, 2))
            elif len(x):
                found.append(plane if solid.kind == POLYGON else _hull(plane))
    return found


def corners_of(solid: Solid) -> Array:
    """Return points on the surface of a solid at rest (n, D), whose hull it is, or the corners of a polygon in 2D.

    Those of a mesh are the corners of one triangle after the other.

    There are none for a solid without bounds.
    """
    dim, points, axes = solid.points.shape[1], solid.points, solid.directions
    if solid.kind == BOX:
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
        return np.asarray(points[0] + (signs * solid.lengths[:dim]) @ axes[:dim])
    if solid.kind == CAPSULE:
        return np.concatenate([end + solid.lengths[0] * _directions(dim) for end in points])
    if solid.kind == CONE and dim == 3:
        axis = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
        side = np.linalg.svd(axis[None])[2][1:]
        circle = _directions(2) @ side
        return np.concatenate([end + radius * circle for end, radius in zip(points, solid.lengths, strict=True)])
    if solid.kind == MESH:
        return mesh_triangles(solid).reshape(-1, 3)
    if solid.kind == POLYGON and dim == 2:
        return np.asarray(points[0] + solid.lengths.reshape(-1, 2) @ axes)
    return np.zeros((0, dim))


def placed(x: Array, row: Array, center: Array) -> Array:
    """Return points (n, D) of a body at rest where it is by a row of its motion; `center` is its centre at rest."""
    dim, at = x.shape[1], columns_of(x.shape[1])
    turn = row[at["rotation"]]
    R = Rotation.from_rotvec(turn if dim == 3 else [0.0, 0.0, turn[0]]).as_matrix()[:dim, :dim]
    return np.asarray(center + row[at["displacement"]] + (x - center) @ R.T)


def _directions(dim: int) -> Array:
    """Return unit vectors: of a circle, or of a sphere."""
    angle = 2.0 * np.pi * np.arange(ROUND) / ROUND
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if dim == 2:
        return circle
    height = np.linspace(-1.0, 1.0, ROUND // 2 + 1)
    ring = np.sqrt(1.0 - height**2)
    flat = ring[:, None, None] * circle
    return np.concatenate([flat, np.broadcast_to(height[:, None, None], (*flat.shape[:2], 1))], axis=2).reshape(-1, 3)


def _hull(plane: Array) -> Array:
    try:
        return np.asarray(plane[ConvexHull(plane).vertices])
    except QhullError:  # it is seen from its edge
        return plane


def silhouette(triangles: Array) -> list[Array]:
    """Return the outlines (k, 2) of what triangles (T, 3, 2) of a plane cover, from an image of them."""
    import contourpy
    from PIL import Image, ImageDraw
    from scipy.ndimage import uniform_filter

    lower, upper = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    pixel = float((upper - lower).max()) / PIXELS
    size = np.ceil((upper - lower) / pixel).astype(int) + 2 * RIM
    image = Image.new("L", (int(size[0]), int(size[1])))
    draw = ImageDraw.Draw(image)
    for corners in ((triangles - lower) / pixel + RIM).tolist():
        draw.polygon([tuple(corner) for corner in corners], fill=255, outline=255)
    covered = uniform_filter(np.asarray(image, float), 3)  # so that the outline has no steps
    contours = contourpy.contour_generator(z=covered, fill_type=contourpy.FillType.OuterOffset)
    filled: Any = contours.filled(127.5, 300.0)  # points, and where those of each loop begin, for each outline
    return [lower + (_one_line(np.split(x, begin[1:-1])) - RIM) * pixel for x, begin in zip(*filled, strict=True)]


def _one_line(loops: list[Array]) -> Array:
    """Return one polygon of an outline and of those of its holes, to which it goes and comes back."""
    line = loops[0]
    for hole in loops[1:]:
        i, k = divmod(int(np.linalg.norm(line[:, None] - hole, axis=2).argmin()), len(hole))
        line = np.concatenate([line[: i + 1], hole[k:-1], hole[: k + 1], line[i:]])
    return line


def plot_rigid(axes: Axes, polygons: list[Array], factor: float) -> PolyCollection:
    """Draw outlines, and return what can be moved."""
    from matplotlib.collections import PolyCollection

    shapes = PolyCollection(
        [factor * polygon for polygon in polygons], facecolor=FACE, edgecolor=GREY, linewidth=0.8, alpha=OPACITY,
        zorder=1.5,
    )  # fmt: skip
    axes.add_collection(shapes, autolim=False)
    return shapes


def extent_of(scene: Scene, motions: RigidMotions | None, steps: list[int], look: View) -> Array:
    """Return points in the plane of a view (n, 2) [m] with the extent of the bounded rigid bodies at some steps."""
    every = [polygon for step in steps for polygon in outlines(scene, motions, step, look)]
    return np.concatenate([np.zeros((0, 2)), *every])

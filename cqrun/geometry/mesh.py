"""A body from a triangle mesh."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from cqrun.errors import MissingExtra, UsageError
from cqrun.explain import Loc, listed
from cqrun.geometry.file_shape import FileShape
from cqrun.geometry.place import Place
from cqrun.geometry.shape import cell_centres, counted_volume
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

FORMATS = (".stl", ".obj", ".ply")

_PROBES = 24
"""Number of points along every axis at which a mesh is checked."""

_COUNTING_CELLS = 200_000
"""Number of lattice cells for a volume that has no formula; a winding number takes microseconds."""

_DECIDED = 0.1
"""Smallest distance of a winding number from 1/2 at which inside and outside can be told apart."""

_NOTHING = 1e-3
"""Smallest share of its bounds that a surface with holes must enclose."""

_OPEN, _CROSSED = 0.1, 0.05
"""Shares of the enclosed volume above which a surface is refused: undecided, and enclosed the wrong way round. Less of
the second gives a warning."""


@dataclass(frozen=True)
class Surface:
    """A mesh as it was read.

    Attributes:
        vertices: (V, 3) in units of the file.
        faces: (T, 3) indices of vertices, counterclockwise seen from outside.
        winding: (P,) winding numbers at `_PROBES`^3 points over the bounds.
        closed: whether every edge belongs to two faces.
    """

    vertices: Array
    faces: Array
    winding: Array
    closed: bool


@plugin("shape", "mesh")
class Mesh(Place, FileShape):
    """The points that a triangle mesh encloses (3D only): STL, OBJ or PLY; needs the extra `mesh`.

    A point is inside if its winding number is above 1/2. So small holes do no harm, and bodies that overlap in a file
    are joined. Local coordinates are those of the file: world = offset + scale R local.
    """

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        if dim != 3:
            return [((), "a mesh needs a 3D world; in 2D use an image or a polygon")]
        return super().dim_problems(dim)

    def inside(self, points: Array) -> Array:
        surface = self._surface()
        return _winding(surface.vertices, surface.faces, self.to_local(points)) > 0.5

    def bounds(self) -> tuple[Array, Array]:
        vertices = self.to_world(self._surface().vertices)
        return vertices.min(axis=0), vertices.max(axis=0)

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        return to.to_world(self.to_local(points)), np.full(len(points), (to.scale / self.scale) ** 3)

    def volume(self) -> float:
        surface = self._surface()
        w = surface.winding
        if (
            not surface.closed or (w > 1.5).any() or (w < -0.5).any()
        ):  # the formula would count it twice, or subtract it
            return counted_volume(self, _COUNTING_CELLS)
        a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
        return float(self.scale**3 * np.einsum("nd,nd->", a, np.cross(b, c)) / 6)

    def examine(self) -> list[str]:
        """Read the file and check its winding numbers w, which are integers if the surface is closed.

        A mesh is refused only if `inside` would be wrong. `inside` tests w > 1/2. So w = 2, where two closed surfaces
        overlap, is as good as w = 1. A hole matters only where it brings w near 1/2, because there a tiny change of the
        mesh would change the particles. Where w = -1, a part of the surface is inside out or crosses itself; that part
        is left out.
        """
        surface = self._surface()
        w = surface.winding
        enclosed = int((w > 0.5).sum())
        if not surface.closed and enclosed < _NOTHING * len(w):
            raise UsageError(f"{self.path}: encloses nothing: it is a sheet, or its holes are too large; close it")
        enclosed = max(1, enclosed)  # a closed surface may lie between the points
        undecided = (np.abs(w - 0.5) < _DECIDED).sum() / enclosed
        if undecided > _OPEN and surface.closed:
            raise UsageError(
                f"{self.path}: crosses itself, or its faces are turned both ways: for {undecided:.0%} of what it "
                "encloses, inside and outside cannot be told apart; repair it where it crosses, or make the normals of "
                "all faces point outward"
            )
        if undecided > _OPEN:
            raise UsageError(
                f"{self.path}: is open: for {undecided:.0%} of what it encloses, inside and outside cannot be told "
                "apart; close its holes, or make the normals of all faces point outward"
            )
        inverted = (w < -0.5).sum() / enclosed
        if inverted > _CROSSED:
            raise UsageError(
                f"{self.path}: crosses itself, or is inside out in parts: {inverted:.0%} as much as it encloses is "
                "enclosed the wrong way round; repair it where it crosses, or turn the normals of those parts"
            )
        warnings = []
        if inverted > 0.0:
            warnings.append(
                f"{self.path}: crosses itself, or is inside out in parts: {inverted:.1%} as much as it encloses is "
                "enclosed the wrong way round, and is left out"
            )
        if not surface.closed:
            warnings.append(f"{self.path}: has holes; they are closed by the winding number")
        if (w > 1.5).any():
            warnings.append(f"{self.path}: surfaces overlap; they are joined")
        return warnings

    def _surface(self) -> Surface:
        return _read(*self.stamp())


def _libraries() -> tuple[Any, Any]:
    """Return the modules trimesh and igl; MissingExtra if one is not installed."""
    try:
        import igl
        import trimesh
    except ModuleNotFoundError as error:
        raise MissingExtra(f"a mesh needs {error.name}, which is not installed: pip install 'cqrun[mesh]'") from None
    return trimesh, igl


def _winding(vertices: Array, faces: Array, points: Array) -> Array:
    """Return the winding numbers (N,) of a surface around points (N, 3)."""
    _, igl = _libraries()
    return np.asarray(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(points, float)))


@lru_cache(maxsize=4)
def _read(path: Path, time: int, size: int) -> Surface:
    """Read the surface in a file, again when it changes; turn it if it is inside out as a whole."""
    trimesh, _ = _libraries()
    if path.suffix.lower() not in FORMATS:
        raise UsageError(f"{path}: a mesh is read from {listed(FORMATS)}; save it as one of them")
    try:
        with warnings.catch_warnings(action="ignore"):  # about the numbers that are refused below
            mesh = trimesh.load_mesh(path, process=False)
            strange = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
            mesh.process()  # silently removes vertices that are not finite
    except Exception as error:  # its readers raise many kinds of errors for a broken file
        raise UsageError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({error}); is the file whole? save it again"
        ) from None
    if strange:
        raise UsageError(f"{path}: {strange} of its points are not finite")
    vertices, faces = np.ascontiguousarray(mesh.vertices, float), np.ascontiguousarray(mesh.faces, np.int64)
    if not len(faces):
        raise UsageError(f"{path}: holds no triangle; is it a {path.suffix[1:].upper()} file of a surface, and whole?")
    lower, upper = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
    if (upper <= lower).any():
        raise UsageError(f"{path}: is flat, so it encloses nothing; a body needs a closed surface")
    points = cell_centres(lower, (upper - lower) / _PROBES, np.full(3, _PROBES))
    winding = _winding(vertices, faces, points)
    if winding.sum() < 0:
        faces, winding = np.ascontiguousarray(faces[:, ::-1]), -winding
    return Surface(vertices, faces, winding, bool(mesh.is_watertight))

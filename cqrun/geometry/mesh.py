"""A body from a triangle mesh."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Self

import numpy as np

from cqrun.errors import MissingExtra, UsageError
from cqrun.explain import Loc
from cqrun.geometry.file_shape import FileShape
from cqrun.geometry.mesh_file import read_triangles
from cqrun.geometry.place import Place
from cqrun.geometry.shape import counted_volume
from cqrun.geometry.surface import CROSSED, Surface, surface_of
from cqrun.geometry.winding import winding_numbers
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

_COUNTING_CELLS = 200_000
"""Number of lattice cells for a volume that has no formula; a winding number takes microseconds."""

_DECIDED = 0.1
"""Smallest distance of a winding number from 1/2 at which inside and outside can be told apart."""

_NOTHING = 1e-3
"""Smallest share of its bounds that a surface with holes must enclose."""

_OPEN, _CROSSED = 0.1, 0.05
"""Shares of the enclosed volume above which a surface is refused: undecided, and enclosed the wrong way round. Less of
the second gives a warning."""


@plugin("shape", "mesh")
class Mesh(Place, FileShape):
    """The points that a triangle mesh encloses (3D only): STL, OBJ or PLY; needs the extra `mesh`.

    A point is inside if its winding number is above 1/2. So small holes do no harm, and bodies that overlap in a file
    are joined. A shell inside another one is a cavity. Faces that are turned over, doubled or loose are mended, with a
    warning. Local coordinates are those of the file: world = offset + scale R local. For a file in millimetres, give
    `scale: 0.001`.
    """

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        if dim != 3:
            return [((), "a mesh needs a 3D world; in 2D use an image or a polygon")]
        return super().dim_problems(dim)

    def inside(self, points: Array) -> Array:
        surface = self._surface()
        return winding_numbers(surface.vertices, surface.faces, self.to_local(points)) > 0.5

    def bounds(self) -> tuple[Array, Array]:
        vertices = self.to_world(self._surface().vertices)
        return vertices.min(axis=0), vertices.max(axis=0)

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        return to.to_world(self.to_local(points)), np.full(len(points), (to.scale / self.scale) ** 3)

    def volume(self) -> float:
        surface = self._surface()
        w = surface.winding
        if surface.fault or (w > 1.5).any() or (w < -0.5).any():  # the formula would count parts twice or subtract them
            return counted_volume(self, _COUNTING_CELLS)
        a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
        return float(self.scale**3 * np.einsum("nd,nd->", a, np.cross(b, c)) / 6)

    def examine(self) -> list[str]:
        """Read the file and check its winding numbers w, which are integers if the surface is closed.

        A mesh that could not be mended (surface.py) is refused only if `inside` would be wrong. `inside` tests w > 1/2.
        So w = 2, where two closed surfaces overlap, is as good as w = 1. A hole matters only where it brings w near
        1/2, because there a tiny change of the mesh would change the particles. Where w = -1, a part of the surface is
        inside out or crosses itself; that part is left out.
        """
        surface = self._surface()
        w = surface.winding
        enclosed = int((w > 0.5).sum())
        if surface.fault and enclosed < _NOTHING * len(w):
            raise UsageError(f"{self.path}: encloses nothing: it is a sheet, or its holes are too large; close it")
        enclosed = max(1, enclosed)  # a closed surface may lie between the points
        undecided = (np.abs(w - 0.5) < _DECIDED).sum() / enclosed
        fault = surface.fault or CROSSED
        if undecided > _OPEN:
            raise UsageError(
                f"{self.path}: {fault.what}: for {undecided:.0%} of what it encloses, inside and outside cannot be "
                f"told apart; {fault.cure}"
            )
        inverted = (w < -0.5).sum() / enclosed
        if inverted > _CROSSED:
            raise UsageError(
                f"{self.path}: crosses itself, or is inside out in parts: {inverted:.0%} as much as it encloses is "
                "enclosed the wrong way round; repair it where it crosses, or turn the normals of those parts"
            )
        warnings = [f"{self.path}: {remark}" for remark in surface.remarks]
        if inverted > 0.0:
            warnings.append(
                f"{self.path}: crosses itself, or is inside out in parts: {inverted:.1%} as much as it encloses is "
                "enclosed the wrong way round, and is left out"
            )
        if surface.fault:
            warnings.append(f"{self.path}: {fault.what}; the winding number decides what is inside")
        if (w > 1.5).any():
            warnings.append(f"{self.path}: surfaces overlap; they are joined")
        return warnings

    def _surface(self) -> Surface:
        return _read(*self.stamp())


@lru_cache(maxsize=4)
def _read(path: Path, time: int, size: int) -> Surface:
    """Read the surface in a file, again when it changes.

    Raises:
        UsageError: it cannot be read, or is flat.
        MissingExtra: a library is not installed.
    """
    try:
        import igl  # noqa: F401
        import trimesh  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingExtra(f"a mesh needs {error.name}, which is not installed: pip install 'cqrun[mesh]'") from None
    vertices, faces = read_triangles(path)
    if (np.ptp(vertices[faces].reshape(-1, 3), axis=0) <= 0).any():
        raise UsageError(f"{path}: is flat, so it encloses nothing; a body needs a closed surface")
    return surface_of(vertices, faces)

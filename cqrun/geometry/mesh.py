"""A body from a triangle mesh."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field

from cqrun.boundaries.solid import MESH, Solid
from cqrun.errors import MissingExtra, UsageError
from cqrun.explain import Loc
from cqrun.geometry.file_shape import FileShape, Stamp, stamp_of
from cqrun.geometry.mesh_file import read_triangles
from cqrun.geometry.mesh_tree import mesh_numbers
from cqrun.geometry.place import Place
from cqrun.geometry.shape import counted_volume
from cqrun.geometry.shells import point_text
from cqrun.geometry.surface import CROSSED, Surface, surface_of
from cqrun.geometry.winding import winding_numbers
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import FileName
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


UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Lengths [m] of the units that a file may have."""


@plugin("shape", "mesh")
class Mesh(Place, FileShape):
    """The points that a triangle mesh encloses (3D only): STL, OBJ or PLY; needs the extra `mesh`.

    Local coordinates are those of the file in metres, by its `units`: world = offset + scale R local. STL files do not
    name their unit, and most CAD programs write millimetres: `units: mm`.

    A point is inside if its winding number is above 1/2. So small holes do no harm, and bodies that overlap in a file
    are joined. A closed shell inside another one is a cavity, whichever way its faces point; so are the shells of the
    files in `cavities`. Faces that are turned over, doubled or loose are mended, with a warning.

    A rigid body or an obstacle of the reference frame may be a mesh, too, if it is closed and does not overlap itself.
    """

    units: Literal["m", "cm", "mm", "in"] = Field(
        description="Unit of the numbers in the files", default="m",
        exclude_if=lambda units: units == "m",  # so that scenes without it keep the names of their runs
    )  # fmt: skip
    cavities: list[FileName] = Field(
        description="Files with closed surfaces that are cut out, in the same coordinates", default_factory=list,
        exclude_if=lambda cavities: not cavities,
    )  # fmt: skip

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        if dim != 3:
            return [((), "a mesh needs a 3D world; in 2D use an image or a polygon")]
        return super().dim_problems(dim)

    def inside(self, points: Array) -> Array:
        surface = self._surface()
        local = self.to_local(points) / UNITS[self.units]
        return winding_numbers(surface.vertices, surface.faces, local) > 0.5

    def distance(self, points: Array) -> tuple[Array, Array] | None:
        """Return the signed distances from the surface and its normals; None if it is open, or crosses itself."""
        surface = self._surface()
        if _undecided(surface):
            return None
        import igl

        kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        local = np.ascontiguousarray(self.to_local(points) / UNITS[self.units], float)
        found = igl.signed_distance(local, surface.vertices, surface.faces, kind)
        return self.scale * UNITS[self.units] * np.asarray(found[0]), np.asarray(found[3]) @ self.matrix(3).T

    def bounds(self) -> tuple[Array, Array]:
        vertices = self.to_world(self._surface().vertices * UNITS[self.units])
        return vertices.min(axis=0), vertices.max(axis=0)

    def solids(self) -> list[Solid]:
        """Return the mesh as a solid, of which inside the bounds the distance is exact.

        Raises:
            UsageError: it has holes, or overlaps itself, so that a distance has no sign; or a file cannot be read.
            MissingExtra: a library is not installed.
        """
        surface = self._surface()
        if why := _undecided(surface):
            raise UsageError(f"the distance from the surface of 'mesh' is not known, since {self.path.name} {why}")
        numbers = _numbers(self.stamp(), self._stamps_of_cavities()).copy()
        numbers[0] = UNITS[self.units]
        return [self.solid_to_world(Solid(MESH, np.zeros((1, 3)), np.eye(3), numbers))]

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        return to.to_world(self.to_local(points)), np.full(len(points), (to.scale / self.scale) ** 3)

    def volume(self) -> float:
        surface = self._surface()
        w = surface.winding
        if surface.fault or (w > 1.5).any() or (w < -0.5).any():  # the formula would count parts twice or subtract them
            return counted_volume(self, _COUNTING_CELLS)
        a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
        return float((self.scale * UNITS[self.units]) ** 3 * np.einsum("nd,nd->", a, np.cross(b, c)) / 6)

    def examine(self) -> list[str]:
        """Read the files, check them, and return warnings.

        Raises:
            UsageError: one of them is no surface of a body, or a cavity does not lie inside it.
        """
        body = _read(*self.stamp())
        warnings = _checked(self.path, body)
        for file in self.cavities:
            path = self.path_of(file)
            cavity = _read(*stamp_of(path))
            warnings += _checked(path, cavity)
            if not (winding_numbers(body.vertices, body.faces, cavity.vertices) > 0.5).any():
                raise UsageError(
                    f"{path}: this cavity, {_extent(cavity)}, lies outside {self.path.name}, {_extent(body)}: export "
                    "both in the same coordinates and the same unit"
                )
        return [*dict.fromkeys(warnings + _checked(self.path, self._surface()))] if self.cavities else warnings

    def _surface(self) -> Surface:
        return _found(self.stamp(), self._stamps_of_cavities())

    def _stamps_of_cavities(self) -> tuple[Stamp, ...]:
        return tuple(stamp_of(self.path_of(file)) for file in self.cavities)


def _undecided(surface: Surface) -> str:
    """Return why the distance from a surface has no sign, in words; empty if it has."""
    if surface.fault:
        return f"{surface.fault.what} ({surface.fault.cure})"
    w = surface.winding
    if (np.minimum(np.abs(w), np.abs(w - 1.0)) > _DECIDED).any():
        return "has surfaces that overlap or cross (make them one)"
    return ""


def _checked(path: Path, surface: Surface) -> list[str]:
    """Check the winding numbers w of a surface, which are integers if it is closed, and return warnings.

    A mesh that could not be mended (surface.py) is refused only if `inside` would be wrong. `inside` tests w > 1/2. So
    w = 2, where two closed surfaces overlap, is as good as w = 1. A hole matters only where it brings w near 1/2,
    because there a tiny change of the mesh would change the particles. Where w = -1, a part of the surface is inside
    out or crosses itself; that part is left out.

    Raises:
        UsageError: no body can be made of it.
    """
    w = surface.winding
    enclosed = int((w > 0.5).sum())
    if surface.fault and enclosed < _NOTHING * len(w):
        raise UsageError(f"{path}: encloses nothing: it is a sheet, or its holes are too large; close it")
    if surface.trouble:
        raise UsageError(f"{path}: {surface.trouble}")
    enclosed = max(1, enclosed)  # a closed surface may lie between the points
    undecided = (np.abs(w - 0.5) < _DECIDED).sum() / enclosed
    fault = surface.fault or CROSSED
    if undecided > _OPEN:
        raise UsageError(
            f"{path}: {fault.what}: for {undecided:.0%} of what it encloses, inside and outside cannot be "
            f"told apart; {fault.cure}"
        )
    inverted = 0.0 if surface.overlap else (w < -0.5).sum() / enclosed
    crossed = (
        "crosses itself, or is inside out in parts: {} as much as it encloses is enclosed the wrong way round "
        f"(at {point_text(surface.probes[int(w.argmin())])})"
    )
    if inverted > _CROSSED:
        raise UsageError(
            f"{path}: {crossed.format(f'{inverted:.0%}')}; repair it where it crosses, or turn the normals of those "
            "parts"
        )
    warnings = [f"{path}: {remark}" for remark in surface.remarks]
    if inverted > 0.0:
        warnings.append(f"{path}: {crossed.format(f'{inverted:.1%}')}, and is left out")
    if surface.fault:
        warnings.append(f"{path}: {fault.what}; the winding number decides what is inside")
    if (w > 1.5).any():
        warnings.append(f"{path}: surfaces overlap; they are joined")
    return warnings


def _extent(surface: Surface) -> str:
    """Return from where to where a surface reaches, as text."""
    lower, upper = (point_text(end(surface.vertices, axis=0)) for end in (np.min, np.max))
    return f"from {lower} to {upper}"


def _found(body: Stamp, cavities: tuple[Stamp, ...]) -> Surface:
    """Return the surface in a file, with those of cavities in others."""
    return _cut_out(body, cavities) if cavities else _read(*body)


@lru_cache(maxsize=8)
def _numbers(body: Stamp, cavities: tuple[Stamp, ...]) -> Array:
    """Return the numbers with which kernels find the distance from a surface, in units of the file."""
    surface = _found(body, cavities)
    return mesh_numbers(surface.vertices, surface.faces)


@lru_cache(maxsize=4)
def _cut_out(body: Stamp, cavities: tuple[Stamp, ...]) -> Surface:
    """Return the surface in a file with those of cavities in others, each with its faces turned inward.

    Raises:
        UsageError: one of them cannot be read, or is flat.
        MissingExtra: a library is not installed.
    """
    parts = [_read(*stamp) for stamp in (body, *cavities)]
    begin = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [parts[0].faces, *(part.faces[:, ::-1] + k for part, k in zip(parts[1:], begin[1:-1], strict=True))]
    return surface_of(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


@lru_cache(maxsize=8)
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

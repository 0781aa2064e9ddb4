"""The triangles in files of other programs: STL, OBJ and PLY."""

from __future__ import annotations

import io
import logging
import re
import warnings
from pathlib import Path

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.geometry.file_shape import require_memory
from cqrun.plugin.contract import Array

FORMATS = (".stl", ".obj", ".ply")

_STL_HEADER, _STL_TRIANGLE = 84, 50
"""Sizes in a binary STL file [bytes]; the last four bytes of the header are the number of triangles."""

_MEMORY, _LINE_MEMORY = 25, 400
"""Memory that reading takes for each byte and each line of a file [bytes], as measured for every format."""

_FARTHEST = 1e9
"""Largest coordinate; beyond 9e10 the points that the library merges are no longer those at the same place."""

_FEWER = "save it with fewer triangles"

_SOLID = re.compile(rb"^[ \t]*(?:end)?solid\b[^\n]*$", re.MULTILINE | re.IGNORECASE)
_DECIMAL_COMMA = re.compile(rb"^[ \t]*(?:v|vertex)?[ \t]*[-+]?[0-9]+,[0-9]", re.MULTILINE)

logging.getLogger("trimesh").addHandler(logging.NullHandler())  # it prints tracebacks of what it can do without


def read_triangles(path: Path) -> tuple[Array, Array]:
    """Return the vertices (V, 3) in a file, those at the same place as one, and its triangles (T, 3).

    Triangles with two corners at the same place are left out: they have no area. Materials and textures are not read:
    they do not change the body.

    Raises:
        UsageError: there are none, the file is not whole, or a number is not finite.
    """
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise UsageError(f"{path}: a mesh is read from {listed(FORMATS)}; save it as one of them")
    require_memory(path, _MEMORY * path.stat().st_size, _FEWER)
    data = path.read_bytes()
    require_memory(path, _MEMORY * len(data) + _LINE_MEMORY * data.count(b"\n"), _FEWER)
    if why := {".stl": _broken_stl, ".obj": _broken_obj, ".ply": _broken_ply}[kind](data):
        raise UsageError(f"{path}: {why}")
    try:
        vertices, faces = _loaded(_one_solid(data) if kind == ".stl" else data, kind)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None
    except Exception as error:  # the readers raise many kinds of errors for a broken file
        if _DECIMAL_COMMA.search(data):
            raise UsageError(f"{path}: its numbers have decimal commas; save it with decimal points") from None
        raise UsageError(
            f"{path}: cannot be read as {kind[1:].upper()} ({error}); is the file whole? save it again"
        ) from None
    if not len(faces):
        raise UsageError(f"{path}: holds no triangle; is it a surface in the format {kind[1:].upper()}, and whole?")
    return vertices, faces


def _loaded(data: bytes, kind: str) -> tuple[Array, Array]:
    """Return vertices and triangles; any exception if that fails."""
    import trimesh

    with warnings.catch_warnings(action="ignore"):  # about numbers that are refused here
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind[1:], process=False, skip_materials=True)
        strange = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        if strange:
            raise UsageError(f"{strange} of its points are not finite")
        if mesh.vertices.shape[1] != 3:  # the reader cuts all points to the length of the shortest
            raise UsageError(f"one of its points has only {mesh.vertices.shape[1]} coordinates; save it again")
        if len(mesh.vertices) and (far := float(np.abs(mesh.vertices).max())) > _FARTHEST:
            raise UsageError(f"one of its points lies {far:.3g} from the origin; at most {_FARTHEST:g} can be read")
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise UsageError(f"its faces name points that are not there: it has {len(mesh.vertices)}")
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)  # without normals and textures, which split it
        mesh.merge_vertices()
    faces = np.asarray(mesh.faces, np.int64)
    a, b, c = faces.reshape(-1, 3).T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return np.ascontiguousarray(mesh.vertices, float), np.ascontiguousarray(faces)


# --- what the readers would misread -------------------------------------------------------------------------


def _broken_stl(data: bytes) -> str:
    """Return why an STL file is not whole; nothing if it may be."""
    if _is_text(data):
        text = data.lower()
        cut = text.lstrip().startswith(b"solid") and text.rfind(b"facet") > text.rfind(b"endsolid")
        return "is a text STL file that ends without `endsolid`: it was cut short; save it again" if cut else ""
    announced = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    held = len(data) - _STL_HEADER
    if held == announced * _STL_TRIANGLE:
        return ""
    though = ", though it begins with `solid` as text files do," if data.startswith(b"solid") else ""
    short = held < announced * _STL_TRIANGLE
    return (
        f"is a binary STL file{though} that announces {announced:,} triangles of {_STL_TRIANGLE} bytes, but has "
        f"{max(0, held):,} bytes of them: "
        + ("it was cut short, or its number is wrong; save it again" if short
           else "its number is wrong, or something else follows; save it again")
    )  # fmt: skip


def _is_text(stl: bytes) -> bool:
    """Return whether an STL file is text; UTF-16 has zero bytes too."""
    return b"\0" not in stl[: 8 * _STL_HEADER] or stl.startswith((b"\xff\xfe", b"\xfe\xff"))


def _one_solid(stl: bytes) -> bytes:
    """Return an STL file of text with all its solids as one without a name.

    The reader makes an object of each solid, which takes milliseconds, and stumbles over names such as `vertex`.
    """
    lines = stl.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\0" in stl or not _SOLID.search(lines):
        return stl
    return b"solid\n" + _SOLID.sub(b"", lines) + b"\nendsolid\n"


def _broken_obj(data: bytes) -> str:
    """Return why an OBJ file would be misread; nothing if it would not.

    Negative indices count back from the face, but the reader counts them from the end of the file.
    """
    relative = re.search(rb"^f[^\n]*[ \t]-", data, re.MULTILINE)
    if relative and re.compile(rb"^v[ \t]", re.MULTILINE).search(data, relative.end()):
        return "counts points back from its faces (negative indices), which cannot be read here; save it with others"
    return ""


def _broken_ply(data: bytes) -> str:
    """Return why a PLY file of text is not whole; nothing if it may be. The reader checks binary ones."""
    head, _, rows = data.partition(b"end_header")
    if not re.search(rb"^format[ \t]+ascii", head, re.MULTILINE):
        return ""
    announced = sum(int(count) for count in re.findall(rb"^element[ \t]+\S+[ \t]+([0-9]{1,18})", head, re.MULTILINE))
    held = rows.strip().count(b"\n") + bool(rows.strip())
    if held >= announced:
        return ""
    return f"announces {announced:,} lines of points and faces, but has {held:,}: it was cut short; save it again"

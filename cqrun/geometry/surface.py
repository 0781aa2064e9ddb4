"""The surface of a body, made of the triangles of a file: what is mended, and what is wrong with it.

A surface is closed if the faces at each of its edges pass it as often in one direction as in the other. Then all its
winding numbers are whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cqrun.geometry.edges import Edges
from cqrun.geometry.shape import cell_centres
from cqrun.geometry.shells import judged, point_text
from cqrun.geometry.winding import winding_numbers
from cqrun.plugin.contract import Array

PROBES = 24
"""Number of points along every axis at which a surface is checked."""


class Fault(NamedTuple):
    """What is wrong with a surface, and what to do about it, in words."""

    what: str
    cure: str


OPEN = Fault("has holes", "close its holes")
ONE_SIDED = Fault("has only one side, as a Moebius strip has", "make it a closed surface")
CROSSED = Fault("crosses itself", "repair it where it crosses")

_MISSING = 0.01
"""Share of an inner shell that may be missing; the winding number closes such holes."""

_SHEET = 0.3
"""Share of a shell that is missing from which it counts as a sheet; of half a ball it is 0.5."""

_BESIDE = 1e-3
"""Distance from a face at which its sides are looked at, in its size."""

_LOOSE = 0.25
"""Largest share of the area that is left out because it encloses nothing."""


@dataclass(frozen=True)
class Surface:
    """A surface whose faces are turned outward, and around cavities into them.

    Attributes:
        vertices: (V, 3) in units of the file.
        faces: (T, 3) indices of vertices, counterclockwise seen from outside.
        probes: (P, 3) `PROBES`^3 points over the bounds.
        winding: (P,) winding numbers there.
        fault: why it is not closed; None if it is.
        remarks: what was mended, in words.
        trouble: why no body can be made of it, in words; empty if one can.
        overlap: whether cavities overlap, so that they are enclosed the wrong way round twice.
    """

    vertices: Array
    faces: Array
    probes: Array
    winding: Array
    fault: Fault | None
    remarks: tuple[str, ...]
    trouble: str = ""
    overlap: bool = False


def surface_of(vertices: Array, faces: Array) -> Surface:
    """Return the surface that triangles form, mended where only one repair is possible.

    Args:
        vertices: (V, 3) in units of the file, each place once.
        faces: (T, 3) indices of vertices; their bounds have a volume.
    """
    faces, remarks = _without_repeats(faces)
    if Edges.of(faces).excess.any():
        for repaired in (_without_loose, _turned_alike):
            faces, more = repaired(vertices, faces)
            remarks += more
        vertices, faces = _used(vertices, faces)
    points = _probes(vertices)
    winding = winding_numbers(vertices, faces, points)
    if winding.sum() < 0:  # inside out as a whole: some programs write faces clockwise
        faces, winding = np.ascontiguousarray(faces[:, ::-1]), -winding
    shells = judged(vertices, faces)
    if shells.turn.any():
        faces = _reversed_where(shells.turn, faces)
        winding = winding_numbers(vertices, faces, points)
    fault, remarks = _fault(vertices, faces), [*remarks, *shells.remarks]
    trouble = shells.trouble or (_open_cavity(vertices, faces) if fault else _no_wall(vertices, faces))
    return Surface(vertices, faces, points, winding, fault, tuple(remarks), trouble, shells.overlap)


# --- repairs ------------------------------------------------------------------------------------------------


def _without_repeats(faces: Array) -> tuple[Array, list[str]]:
    """Return the faces, each once.

    Two faces back to back are also the wall between two bodies that touch. Such a wall stays: with one of its sides
    alone, three faces would meet at its edges.
    """
    corners = np.sort(faces, axis=1)
    order = np.lexsort(corners.T)  # stable, so of equal faces the file's first is the first
    once = np.ones(len(faces), bool)
    once[order[1:]] = (np.diff(corners[order], axis=0) != 0).any(axis=1)
    if once.all() or not (Edges.of(faces).excess.any() or _even(faces[once])):
        return faces, []
    return faces[once], [f"{_count((~once).sum(), 'face is', 'faces are')} there more than once; one of each is used"]


def _without_loose(vertices: Array, faces: Array) -> tuple[Array, list[str]]:
    """Return the faces without those that enclose nothing, if these are few and the rest is closed."""
    edges = Edges.of(faces)
    piece = edges.pieces(edges.faces == 2)
    out = np.isin(piece, piece[(edges.faces[edges.at] == 1).any(axis=1)])
    normals = _normals(vertices, faces)
    area = 0.5 * np.linalg.norm(normals, axis=1)
    shells = [k for k in np.unique(piece[out]) if _missing(normals[piece == k]) < _SHEET]  # these have holes
    out &= ~np.isin(piece, shells)
    if not out.any() or area[out].sum() > _LOOSE * area.sum() or not _even(faces[~out]):
        return faces, []
    return faces[~out], [f"{_count(out.sum(), 'face encloses', 'faces enclose')} nothing, and {_are(out)} left out"]


def _turned_alike(vertices: Array, faces: Array) -> tuple[Array, list[str]]:
    """Return the faces, in every piece turned like most of the piece."""
    import igl

    alike, piece = igl.bfs_orient(np.ascontiguousarray(faces))
    changed = (alike != faces).any(axis=1)
    wrong = changed != (np.bincount(piece, changed) > 0.5 * np.bincount(piece))[piece]
    if not wrong.any():
        return faces, []
    were, they = ("was", "it is") if wrong.sum() == 1 else ("were", "they are")
    remark = f"{wrong.sum():,} of its {len(faces):,} faces {were} turned over against the others; {they} turned back"
    return _reversed_where(wrong, faces), [remark]


# --- what is wrong ------------------------------------------------------------------------------------------


def _fault(vertices: Array, faces: Array) -> Fault | None:
    """Return why a surface is not closed; None if it is."""
    edges = Edges.of(faces)
    if not edges.excess.any():
        return None
    holes = bool((edges.faces == 1).any())
    crowded = np.flatnonzero((edges.faces > 2) & (edges.excess != 0))
    if not len(crowded):
        return OPEN if holes else ONE_SIDED
    place = point_text(vertices[edges.ends[crowded[0]]].mean(axis=0))
    what = f"{_count(len(crowded), 'edge', 'edges')} at which more than two faces meet, such as at {place}"
    cure = "delete its inner walls, and faces that stick out of it"
    return Fault(f"{OPEN.what} and {what}", f"{cure}; {OPEN.cure}") if holes else Fault(f"has {what}", cure)


def _open_cavity(vertices: Array, faces: Array) -> str:
    """Return which inner shell is open, in words; empty if none is."""
    edges = Edges.of(faces)
    if not (edges.faces == 1).any():
        return ""
    piece = edges.pieces(np.ones(len(edges.ends), bool))
    normals = _normals(vertices, faces)
    rim = (edges.faces[edges.at] == 1).any(axis=1)  # faces at a hole
    for k in np.unique(piece[rim]):
        own = piece == k
        missing = _missing(normals[own])
        ends = edges.ends[np.unique(edges.at[own][edges.faces[edges.at[own]] == 1])].reshape(-1)
        if own.all() or missing < _MISSING:
            continue
        rest = winding_numbers(vertices, np.ascontiguousarray(faces[~own]), vertices[ends])
        if np.median(np.abs(rest)) > 0.5:
            return (
                f"an inner shell has a hole at {point_text(vertices[ends].mean(axis=0))}, of about {missing:.0%} of "
                "its surface: a cavity must be closed; close its holes"
            )
    return ""


def _missing(normals: Array) -> float:
    """Return the share of a shell that its holes are, from the area vectors (T, 3) of its faces."""
    return float(np.linalg.norm(normals.sum(axis=0)) / max(np.linalg.norm(normals, axis=1).sum(), 1e-300))


def _normals(vertices: Array, faces: Array) -> Array:
    """Return normals (T, 3) of faces, twice as long as their areas."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def _no_wall(vertices: Array, faces: Array) -> str:
    """Return where a wall has no thickness, in words; empty if all have some."""
    edges = Edges.of(faces)
    crowded = np.flatnonzero((edges.faces[edges.at] > 2).any(axis=1))
    if not len(crowded):
        return ""
    normal, middle = _normals(vertices, faces[crowded]), vertices[faces[crowded]].mean(axis=1)
    size = np.sqrt(np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300))
    away = _BESIDE * normal / size
    empty = [np.abs(winding_numbers(vertices, faces, middle + sign * away)) < 0.5 for sign in (1, -1)]
    found = np.flatnonzero(empty[0] & empty[1])
    if not len(found):
        return ""
    return (
        f"a wall has no thickness at {point_text(middle[found[0]])}: two cavities meet there, or a cavity and the "
        "outside; leave a wall, or delete it"
    )


def _probes(vertices: Array) -> Array:
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    return cell_centres(lower, (upper - lower) / PROBES, np.full(3, PROBES))


def _used(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Return the vertices that faces use, and the faces with their new indices."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], np.ascontiguousarray(index.reshape(-1, 3))


def _even(faces: Array) -> bool:
    """Return whether an even number of faces meets at every edge: a closed surface, if some of them are turned."""
    return len(faces) > 0 and not (Edges.of(faces).faces % 2).any()


def _reversed_where(wrong: Array, faces: Array) -> Array:
    return np.ascontiguousarray(np.where(wrong[:, None], faces[:, ::-1], faces))


def _count(number: int, one: str, more: str) -> str:
    return f"{number:,} {one if number == 1 else more}"


def _are(chosen: Array) -> str:
    return "is" if chosen.sum() == 1 else "are"

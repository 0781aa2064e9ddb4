"""The shells of a surface: which of them are cavities, because they lie inside another shell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.geometry.edges import Edges
from cqrun.geometry.winding import winding_numbers
from cqrun.plugin.contract import Array

_INSIDE, _OUTSIDE = 0.9, 0.1
"""Winding numbers of points that clearly lie inside and outside; at the corner of a box it is 1/8."""

_CLOSED = 0.1
"""Length of the sum of all area vectors, relative to the area, below which a shell counts as closed."""

_MOST_SHELLS = 1000
"""A surface of more shells, such as a scan with crumbs, is taken as it is."""


@dataclass(frozen=True)
class Shell:
    """A connected part of a surface that is closed, or nearly.

    Attributes:
        index: its number among the parts of the surface.
        points: (V, 3) its vertices.
        faces: (T, 3) indices of its vertices.
        volume: what it encloses; negative if its faces are turned inward.
    """

    index: int
    points: Array
    faces: Array
    volume: float


def shells_to_turn(vertices: Array, faces: Array) -> tuple[Array, list[str]]:
    """Return the faces (T,) bool of the shells that are turned the wrong way, and remarks in words.

    A shell encloses material, and a shell inside it a cavity, in which the next one encloses material again, however
    their normals point. A shell that crosses another one stays as it is: both are joined.
    """
    edges = Edges.of(faces)
    piece = edges.pieces(np.ones(len(edges.ends), bool))
    shells = _shells(vertices, faces, piece)
    if not 1 < len(shells) <= _MOST_SHELLS:
        return np.zeros(len(faces), bool), []
    within, crosses = _relations(shells)
    cavity = within.sum(axis=1) % 2 == 1
    wrong = ~crosses & ((np.array([shell.volume for shell in shells]) < 0) != cavity)
    remarks = []
    if count := int((wrong & ~cavity).sum()):
        remarks.append(f"{count} of its {len(shells)} shells {_were(count)} inside out; turned outward")
    if count := int((wrong & cavity).sum()):
        remarks.append(
            f"{count} of its {len(shells)} shells {'lies' if count == 1 else 'lie'} inside another one and "
            f"{'counts' if count == 1 else 'count'} as a cavity, though the normals point out of it; if there should "
            "be material inside, delete the inner shell"
        )
    return np.isin(piece, [shell.index for shell, turn in zip(shells, wrong, strict=True) if turn]), remarks


def _shells(vertices: Array, faces: Array, piece: Array) -> list[Shell]:
    """Return the pieces of a surface that are closed, or nearly."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    total = np.stack([np.bincount(piece, axis) for axis in normals.T], axis=1)
    closed = np.linalg.norm(total, axis=1) < _CLOSED * np.bincount(piece, np.linalg.norm(normals, axis=1))
    order = np.argsort(piece, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(piece))[:-1])
    shells = []
    for k in np.flatnonzero(closed)[: _MOST_SHELLS + 1]:
        used, index = np.unique(faces[members[k]], return_inverse=True)
        points = vertices[used]
        height = a[members[k]] - points.mean(axis=0)  # about its middle, so that small holes do little harm
        volume = float(np.einsum("nd,nd->", height, normals[members[k]]) / 6)
        shells.append(Shell(int(k), points, np.ascontiguousarray(index.reshape(-1, 3)), volume))
    return shells


def _relations(shells: list[Shell]) -> tuple[Array, Array]:
    """Return which shells lie inside which others (n, n) bool, and which cross another one (n,) bool."""
    n = len(shells)
    lower, upper = (np.array([end(shell.points, axis=0) for shell in shells]) for end in (np.min, np.max))
    some_inside, some_outside = np.zeros((n, n), bool), np.ones((n, n), bool)
    for j, shell in enumerate(shells):
        near = np.flatnonzero(((lower <= upper[j]) & (upper >= lower[j])).all(axis=1) & (np.arange(n) != j))
        if not len(near):
            continue
        points = [shells[i].points for i in near]
        w = np.abs(winding_numbers(shell.points, shell.faces, np.concatenate(points)))
        for i, part in zip(near, np.split(w, np.cumsum([len(p) for p in points])[:-1]), strict=True):
            some_inside[i, j], some_outside[i, j] = (part > _INSIDE).any(), (part < _OUTSIDE).any()
    crosses = some_inside & (some_outside | some_inside.T)
    return some_inside & ~crosses, np.asarray((crosses | crosses.T).any(axis=1))


def _were(count: int) -> str:
    return "was" if count == 1 else "were"

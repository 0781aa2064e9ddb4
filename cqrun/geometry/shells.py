"""The shells of a surface: which of them are cavities, because they lie inside another shell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cqrun.geometry.edges import Edges
from cqrun.geometry.winding import winding_numbers
from cqrun.plugin.contract import Array

_INSIDE, _OUTSIDE = 0.9, 0.1
"""Winding numbers of points that clearly lie inside and outside; at the corner of a box it is 1/8."""

_CLOSED = 0.1
"""Length of the sum of all area vectors, relative to the area, below which a shell counts as closed."""

_TOUCHING = 1e-5
"""Distance below which two shells touch, relative to the diagonal of both."""

_MOSTLY = 0.5
"""Share of the samples of a shell inside another from which it may have been meant as a cavity."""

_MOST_SHELLS = 1000
"""A surface of more shells, such as a scan with crumbs, is taken as it is."""


@dataclass(frozen=True)
class Shell:
    """A connected part of a surface that is closed, or nearly.

    Attributes:
        index: its number among the parts of the surface.
        points: (V, 3) its vertices.
        faces: (T, 3) indices of its vertices.
        samples: (S, 3) vertices, middles of edges and of faces.
        volume: what it encloses; negative if its faces are turned inward.
    """

    index: int
    points: Array
    faces: Array
    samples: Array
    volume: float


class Judgement(NamedTuple):
    """What shells are.

    Attributes:
        turn: (T,) bool, the faces of shells that are turned the wrong way.
        remarks: what a user should know, in words.
        trouble: why no body can be made of them, in words; empty if one can.
        overlap: whether cavities overlap, which count as one.
    """

    turn: Array
    remarks: list[str]
    trouble: str = ""
    overlap: bool = False


class _Relations(NamedTuple):
    """Which of n shells lie inside which others and which cross (n, n) bool; the share of each that is inside (n, n).

    `at` has a sample of a shell outside another one that it crosses, by their numbers.
    """

    within: Array
    crosses: Array
    share: Array
    at: dict[tuple[int, int], Array]


def judged(vertices: Array, faces: Array) -> Judgement:
    """Return what the shells of a surface are, of vertices (V, 3) and faces (T, 3).

    A shell encloses material, and a shell inside it a cavity, in which the next one encloses material again, however
    their normals point. Of shells that cross, the normals decide: material is joined, and a cavity must not pass
    through the skin. Cavities that cross are one.
    """
    edges = Edges.of(faces)
    piece = edges.pieces(np.ones(len(edges.ends), bool))
    shells = _shells(vertices, faces, piece)
    if not 1 < len(shells) <= _MOST_SHELLS:
        return Judgement(np.zeros(len(faces), bool), [])
    relations = _relations(shells)
    within, crosses = relations.within, relations.crosses
    cavity, inward = within.sum(axis=1) % 2 == 1, np.array([shell.volume for shell in shells]) < 0
    together = (within.astype(int) @ within.T.astype(int)) > 0  # inside a third one
    alike = together & (inward[:, None] == inward)
    wrong = (inward != cavity) & ~(crosses & ~alike).any(axis=1)
    turn = np.isin(piece, [shell.index for shell, turned in zip(shells, wrong, strict=True) if turned])
    overlap = crosses & alike & cavity & cavity[:, None]
    remarks = _turned(len(shells), wrong & ~cavity, wrong & cavity)
    if pairs := np.argwhere(np.triu(overlap)).tolist():
        remarks.append(f"inner shells overlap, such as at {_place(relations.at, pairs[0])}; they count as one cavity")
    sunk = crosses & ~together & ~inward & ~inward[:, None] & (relations.share > _MOSTLY)
    if pairs := np.argwhere(sunk).tolist():
        remarks.append(
            f"a shell lies mostly inside another one, but passes through it at {_place(relations.at, pairs[0])}: both "
            "are joined; if it should be a cavity, let it lie inside"
        )
    through = crosses & ~together & inward[:, None] & ~inward
    if pairs := np.argwhere(through).tolist():
        trouble = (
            f"a shell whose faces point inward passes through another one at {_place(relations.at, pairs[0])}: a "
            "cavity must lie inside; if it should be material, turn its normals outward"
        )
    else:
        trouble = _touching(shells, within, crosses, cavity)
    return Judgement(turn, remarks, trouble, bool(overlap.any()))


def _turned(count: int, outer: Array, inner: Array) -> list[str]:
    """Return remarks on shells that are turned: bodies and cavities (n,) bool."""
    remarks = []
    if some := int(outer.sum()):
        remarks.append(f"{some} of its {count} shells {'was' if some == 1 else 'were'} inside out; turned outward")
    if some := int(inner.sum()):
        remarks.append(
            f"{some} of its {count} shells {'lies' if some == 1 else 'lie'} inside another one and "
            f"{'counts' if some == 1 else 'count'} as a cavity, though the normals point out of it; if there should be "
            "material inside, delete the inner shell"
        )
    return remarks


def _touching(shells: list[Shell], within: Array, crosses: Array, cavity: Array) -> str:
    """Return where a cavity has no wall, in words; empty if all have one."""
    for i in np.flatnonzero(cavity):
        for j in np.flatnonzero(within[i] & ~cavity):
            if (place := _meeting(shells[i], shells[j])) is not None:
                return f"a cavity touches the outer surface at {point_text(place)}: it has no wall there; leave one"
        for j in np.flatnonzero(cavity & ~crosses[i] & (within == within[i]).all(axis=1)):
            if j > i and (place := _meeting(shells[i], shells[j])) is not None:
                return f"two cavities meet at {point_text(place)}: leave a wall between them, or make them one"
    return ""


def _meeting(one: Shell, other: Shell) -> Array | None:
    """Return a place (3,) where two shells touch; None if they do not."""
    import igl

    lower, upper = (np.array([end(s.points, axis=0) for s in (one, other)]) for end in (np.min, np.max))
    near = _TOUCHING * float(np.linalg.norm(upper.max(axis=0) - lower.min(axis=0)))
    if (lower.max(axis=0) > upper.min(axis=0) + near).any():
        return None
    for a, b in ((one, other), (other, one)):
        square = np.asarray(igl.point_mesh_squared_distance(a.samples, b.points, b.faces)[0])
        if len(found := a.samples[square < near**2]):
            return np.asarray(found[np.linalg.norm(found - found.mean(axis=0), axis=1).argmin()])
    return None


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
        corners = vertices[faces[members[k]]]
        samples = np.concatenate([points, *(0.5 * (corners[:, i] + corners[:, i - 1]) for i in range(3)),
                                  corners.mean(axis=1)])  # fmt: skip
        shells.append(Shell(int(k), points, np.ascontiguousarray(index.reshape(-1, 3)), samples, volume))
    return shells


def _relations(shells: list[Shell]) -> _Relations:
    """Return which shells lie inside which others, and which cross."""
    n = len(shells)
    lower, upper = (np.array([end(shell.points, axis=0) for shell in shells]) for end in (np.min, np.max))
    some_inside, some_outside, share = np.zeros((n, n), bool), np.ones((n, n), bool), np.zeros((n, n))
    at: dict[tuple[int, int], Array] = {}
    for j, shell in enumerate(shells):
        near = np.flatnonzero(((lower <= upper[j]) & (upper >= lower[j])).all(axis=1) & (np.arange(n) != j))
        if not len(near):
            continue
        points = [shells[i].samples for i in near]
        w = np.abs(winding_numbers(shell.points, shell.faces, np.concatenate(points)))
        for i, x, part in zip(
            near.tolist(), points, np.split(w, np.cumsum([len(p) for p in points])[:-1]), strict=True
        ):
            some_inside[i, j], some_outside[i, j] = (part > _INSIDE).any(), (part < _OUTSIDE).any()
            share[i, j], at[i, j] = (part > _INSIDE).mean(), x[int(part.argmin())]
    crosses = some_inside & (some_outside | some_inside.T)
    return _Relations(some_inside & ~crosses, crosses | crosses.T, share, at)


def _place(at: dict[tuple[int, int], Array], pair: list[int]) -> str:
    """Return where the first shell of a pair is outside the second, or the second outside the first, as text."""
    i, j = pair
    return point_text(at[i, j] if (i, j) in at else at[j, i])


def point_text(x: Array) -> str:
    """Return a point (3,) as text."""
    return "(" + ", ".join(f"{c + 0.0:.4g}" for c in x) + ")"

"""Surfaces out of triangles: what is mended, and what is inside whatever way the faces are turned."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from cqrun.geometry.surface import Surface, surface_of
from cqrun.geometry.winding import winding_numbers
from cqrun.plugin.contract import Array

BALL = trimesh.creation.icosphere(subdivisions=2)
BOX = trimesh.creation.box((1, 1, 1))
N = len(BALL.faces)


def placed(
    body: Any, scale: float = 1.0, offset: tuple[float, float, float] = (0, 0, 0), *, inward: bool = False
) -> Any:
    other = body.copy()
    other.apply_scale(scale)
    other.apply_translation(offset)
    if inward:
        other.invert()
    return other


def surface(*bodies: Any) -> Surface:
    """Return the surface of one file with several bodies, those of their vertices that meet as one."""
    joined = trimesh.util.concatenate(list(bodies))
    joined.merge_vertices()
    return surface_of(np.array(joined.vertices), np.array(joined.faces))


def with_faces(body: Any, faces: Array) -> Any:
    return trimesh.Trimesh(body.vertices, faces, process=False)


def turned(body: Any, which: Any) -> Any:
    faces = np.array(body.faces)
    faces[which] = faces[which][:, ::-1]
    return with_faces(body, faces)


def inside(body: Surface, *points: tuple[float, float, float]) -> list[bool]:
    return (winding_numbers(body.vertices, body.faces, np.array(points, float)) > 0.5).tolist()


def volume(body: Surface) -> float:
    a, b, c = body.vertices[body.faces].transpose(1, 0, 2)
    return float(np.einsum("nd,nd->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("share", [1 / N, 0.1, 0.4, 0.6, 0.9])
def test_faces_that_are_turned_over_are_turned_back(share: float, rng: np.random.Generator) -> None:
    which = rng.choice(N, round(share * N), replace=False)
    mended = surface(turned(BALL, which))
    assert mended.fault is None
    assert volume(mended) == pytest.approx(BALL.volume)
    few = min(len(which), N - len(which))  # where most are turned, the whole ball is inside out
    assert mended.remarks[0].startswith(f"{few} of its {N} faces {'was' if few == 1 else 'were'} turned over")


@pytest.mark.parametrize("outer", [False, True], ids=["outer out", "outer in"])
@pytest.mark.parametrize("inner", [False, True], ids=["inner out", "inner in"])
def test_shell_inside_another_is_a_cavity_however_its_normals_point(outer: bool, inner: bool) -> None:
    hollow = surface(placed(BALL, inward=outer), placed(BALL, 0.5, inward=inner))
    assert inside(hollow, (0, 0, 0), (0.7, 0, 0)) == [False, True]
    assert volume(hollow) == pytest.approx(BALL.volume * (1 - 0.125))
    assert hollow.fault is None
    asked = [remark for remark in hollow.remarks if "counts as a cavity, though the normals point out of it" in remark]
    assert len(asked) == (outer == inner)


def test_body_inside_a_cavity_is_filled() -> None:
    nested = surface(BALL, placed(BALL, 0.6), placed(BALL, 0.3))
    assert inside(nested, (0, 0, 0), (0.4, 0, 0), (0.8, 0, 0)) == [True, False, True]


def test_cavity_of_a_ball_with_a_hole_stays_empty() -> None:
    hollow = surface(with_faces(BALL, BALL.faces[3:]), placed(BALL, 0.5))
    assert inside(hollow, (0, 0, 0), (0.7, 0, 0)) == [False, True]


def test_shells_that_cross_are_no_cavities() -> None:
    both = surface(BALL, placed(BALL, 0.5, (0.8, 0, 0)))
    (remark,) = both.remarks
    assert remark.startswith("a shell lies mostly inside another one, but passes through it at (1.1")
    assert remark.endswith("both are joined; if it should be a cavity, let it lie inside")
    assert both.trouble == ""
    assert inside(both, (0, 0, 0), (0.9, 0, 0), (1.2, 0, 0)) == [True, True, True]


def test_body_beside_another_that_is_inside_out_is_turned() -> None:
    both = surface(BALL, placed(BALL, 0.5, (2, 0, 0), inward=True))
    assert both.remarks == ("1 of its 2 shells was inside out; turned outward",)
    assert volume(both) == pytest.approx(1.125 * BALL.volume)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("count", [1, 20, N])
def test_faces_that_are_there_twice_count_once(count: int, reverse: bool) -> None:
    again = BALL.faces[:count, ::-1] if reverse else BALL.faces[:count]
    once = surface(with_faces(BALL, np.concatenate([BALL.faces, again])))
    assert once.fault is None
    assert volume(once) == pytest.approx(BALL.volume)
    words = "1 face is" if count == 1 else f"{count} faces are"
    assert once.remarks == (f"{words} there more than once; one of each is used",)


@pytest.mark.parametrize("wrong", [[], [4]])
def test_wall_between_bodies_that_touch_is_no_fault(wrong: list[int]) -> None:
    both = surface(turned(BOX, wrong), placed(BOX, 1.0, (1, 0, 0)))
    assert both.fault is None
    assert volume(both) == pytest.approx(2.0)
    assert inside(both, (0, 0, 0), (0.49, 0, 0), (0.51, 0, 0), (1, 0, 0)) == [True] * 4


def test_faces_that_enclose_nothing_are_left_out() -> None:
    a, b = BALL.vertices[BALL.faces[0][:2]]
    fin = trimesh.Trimesh([a, b, [1.5, 1.5, 1.5]], [[0, 1, 2]])
    stray = trimesh.Trimesh([[3, 0, 0], [3, 0.1, 0], [3, 0, 0.1]], [[0, 1, 2]])
    clean = surface(BALL, fin, stray)
    assert clean.remarks == ("2 faces enclose nothing, and are left out",)
    assert clean.fault is None
    assert np.abs(clean.vertices).max() == pytest.approx(1.0)  # so that the bounds are those of the body


def test_small_closed_crumb_does_not_replace_a_body_with_a_hole() -> None:
    body = surface(with_faces(BALL, BALL.faces[1:]), placed(BALL, 0.1, (2, 0, 0)))
    assert body.fault is not None
    assert body.fault.what == "has holes"
    assert inside(body, (0, 0, 0), (2, 0, 0)) == [True, True]


def test_inner_wall_is_named() -> None:
    lower, upper = placed(BOX), placed(BOX, 1.0, (0, 0, 1))
    both = trimesh.util.concatenate([lower, upper])
    wall = np.flatnonzero(np.abs(both.triangles_center[:, 2] - 0.5) < 1e-9)
    body = surface(with_faces(both, np.delete(both.faces, wall[:2], axis=0)))
    assert body.fault is not None
    assert body.fault.what.startswith("has 4 edges at which more than two faces meet, such as at (")


def test_surface_of_one_side_is_named() -> None:
    # a Klein bottle: a tube whose end is joined to its beginning the other way round
    n = 8
    u, v = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")

    def index(i: Array, j: Array) -> Array:
        return (i % n) * n + np.where(i >= n, -j, j) % n

    a, b, c, d = index(u, v), index(u + 1, v), index(u + 1, v + 1), index(u, v + 1)
    faces = np.concatenate([np.stack(three, axis=-1).reshape(-1, 3) for three in ((a, b, c), (a, c, d))])
    angle, around = 2 * np.pi * np.arange(n * n).reshape(n, n) // n / n, 2 * np.pi * np.arange(n) / n
    points = np.stack([np.cos(angle), np.sin(angle) + 0 * around, 0.3 * np.sin(around) + 0 * angle], axis=-1)
    fault = surface_of(points.reshape(-1, 3), faces).fault
    assert fault is not None
    assert fault.what == "has only one side, as a Moebius strip has"

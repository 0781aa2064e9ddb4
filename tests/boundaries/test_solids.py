"""Signed distances of solids: against differences, and against the distance to a polyline by brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from cqrun.boundaries.solid import (
    BOX,
    CAPSULE,
    CONE,
    HILLS,
    PLANE,
    POLYGON,
    TAPER,
    TERRAIN,
    Solid,
    make_solids,
    signed_distance,
)

ANGLE = 0.3
TURNED = np.array([[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1]])
ARROW = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [0.0, 0.1], [-0.5, 0.5]])
PROFILE = np.array([[-0.5, 0.1], [-0.2, 0.3], [0.1, 0.0], [0.3, 0.4], [0.5, 0.1]])
BAR = [[0, 0, 0], [0.3, 0.4, 0.5]]


def solid(kind, points, directions, lengths):
    """Return a solid in 3D."""
    return Solid(kind, *(np.array(a, float).reshape(-1, 3) for a in (points, directions)), np.array(lengths, float))


SOLIDS = {
    "plane": solid(PLANE, [0, 0, 0], [0.6, 0.8, 0], []),
    "box": solid(BOX, [0.1, 0.2, 0], TURNED.T, [0.5, 0.4, 0.3]),
    "capsule": solid(CAPSULE, BAR, [], [0.4]),
    "ball": solid(CAPSULE, BAR[:1] * 2, [], [0.4]),
    "cylinder": solid(CONE, BAR, [], [0.4, 0.4]),
    "cone": solid(CONE, BAR, [], [0.5, 0.2]),
    "tapered capsule": solid(TAPER, BAR, [], [0.45, 0.2]),
    "polygon": solid(POLYGON, [0, 0, 0], TURNED[:2], ARROW.ravel()),
    "terrain": solid(TERRAIN, [0, 0, 0], TURNED[:2], PROFILE.ravel()),
    "hills": solid(HILLS, [0, 0, 0], TURNED[:2], [0.1, 1.0, 0.05, 0.3]),
}


def at(name, x):
    """Return d, n, alpha, t of a solid at positions (N, 3)."""
    table = make_solids([SOLIDS[name]])
    found = [signed_distance(table, 0, tuple(p)) for p in x]
    return tuple(np.array(each) for each in zip(*found, strict=True))


@pytest.mark.parametrize("name", SOLIDS)
def test_the_normal_and_the_curvature_are_derivatives(name, rng):
    """Inside, and in hills only near the surface; a few points whose nearest face changes are excepted."""
    x, h = rng.uniform(-0.8, 0.8, (1500, 3)), 1e-6
    d, n, alpha, t = at(name, x)
    chosen = (d < 0) & (d > -0.03 if name == "hills" else True)
    x, n, alpha, t = x[chosen], n[chosen], alpha[chosen], t[chosen]
    slope, turn = np.zeros(x.shape), np.zeros((*x.shape, 3))
    for axis, step in enumerate(h * np.eye(3)):
        (d_up, n_up, *_), (d_down, n_down, *_) = at(name, x + step), at(name, x - step)
        slope[:, axis], turn[:, :, axis] = (d_up - d_down) / (2 * h), (n_up - n_down) / (2 * h)
    flat = np.eye(3) - n[:, :, None] * n[:, None, :] - t[:, :, None] * t[:, None, :]
    wrong = np.abs(slope - n).max(axis=1) > 1e-7
    wrong |= np.abs(turn - alpha[:, None, None] * flat).max(axis=(1, 2)) > 1e-3
    assert len(x) > 20
    assert wrong.mean() < 2e-3
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, rtol=1e-14)


@pytest.mark.parametrize("name", SOLIDS)
def test_no_surface_is_nearer_than_the_distance(name, rng):
    """A distance changes by no more than the way between two positions."""
    x = rng.uniform(-1.2, 1.2, (4000, 3))
    y = x + 0.1 * rng.normal(size=x.shape)
    d, d_y = at(name, x)[0], at(name, y)[0]
    crossed = (d > 0) & (d_y < 0)
    assert crossed.sum() > 10
    assert (d[crossed] <= np.linalg.norm(y - x, axis=1)[crossed]).all()


@pytest.mark.parametrize(("name", "corners"), [
    ("polygon", [*ARROW, ARROW[0]]), ("terrain", [[-50, 0.1], *PROFILE, [50, 0.1]]),
])  # fmt: skip
def test_the_distance_to_a_line_of_edges_is_that_of_the_nearest(name, corners, rng):
    x = rng.uniform(-0.9, 0.9, (1000, 3))
    plane, nearest = x @ TURNED[:2].T, np.full(len(x), np.inf)
    for a, b in itertools.pairwise(np.array(corners, float)):
        along = np.clip((plane - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(plane - a - along[:, None] * (b - a), axis=1))
    np.testing.assert_allclose(np.abs(at(name, x)[0]), nearest, rtol=0, atol=1e-14)


def test_a_solid_moves_with_its_place(rng):
    x = rng.uniform(-0.8, 0.8, (200, 3))
    scale, offset = 1.7, np.array([0.1, -0.2, 0.3])
    for name, one in SOLIDS.items():
        table = make_solids([one.placed(scale, TURNED, offset)])
        d = np.array([signed_distance(table, 0, tuple(offset + scale * TURNED @ p))[0] for p in x])
        np.testing.assert_allclose(d, scale * at(name, x)[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("radii", [(0.5, 0.2), (0.2, 0.5), (0.3, 0.3)])
def test_the_distance_to_a_cone_is_that_of_the_nearest_facet(radii, rng):
    """In the plane of its axis a cone is a trapezoid."""
    a, b = radii
    corners = np.array([[-a, 0.0], [a, 0.0], [b, 0.7], [-b, 0.7]])
    cone, plate = (
        solid(CONE, [[0, 0, 0], [0, 0.7, 0]], [], radii),
        solid(POLYGON, [0, 0, 0], np.eye(3)[:2], corners.ravel()),
    )
    table = make_solids([cone, plate])
    x = rng.uniform(-1, 1.5, (2000, 3)) * [1, 1, 0]
    d = np.array([[signed_distance(table, k, tuple(p))[0] for k in (0, 1)] for p in x])
    assert (d[:, 0] < 0).sum() > 50
    np.testing.assert_allclose(d[:, 0], d[:, 1], rtol=0, atol=1e-14)


@pytest.mark.parametrize("radii", [(0.5, 0.2), (0.2, 0.5), (0.3, 0.3)])
def test_the_distance_to_a_tapered_capsule_is_the_least_to_the_balls_in_it(radii, rng):
    """It is the union of balls whose centres lie on the axis."""
    table = make_solids([solid(TAPER, BAR, [], radii)])
    x = np.concatenate([rng.uniform(-1, 1.3, (500, 3)), np.linspace(*np.array(BAR, float), 9)])
    share = np.linspace(0, 1, 4001)[:, None]
    centres, radius = share * BAR[1], radii[0] + share[:, 0] * (radii[1] - radii[0])
    least = np.array([(np.linalg.norm(p - centres, axis=1) - radius).min() for p in x])
    d = np.array([signed_distance(table, 0, tuple(p))[0] for p in x])
    np.testing.assert_allclose(d, least, rtol=0, atol=1e-6)

"""The signed distance of triangle meshes: against boxes, balls and brute force, and its derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_solids import TURNED

from cqrun.boundaries.solid import BOX, CAPSULE, MESH, POLYGON, Solid, make_solids, signed_distance
from cqrun.geometry.mesh_tree import mesh_numbers, mesh_triangles

trimesh = pytest.importorskip("trimesh")
igl = pytest.importorskip("igl")

HALF = np.array([0.2, 0.3, 0.4])
ELL = np.array([[0, 0], [1, 0], [1, 0.4], [0.4, 0.4], [0.4, 1], [0, 1.0]])


def solid_of(vertices: Any, faces: Any) -> Solid:
    """Return a mesh as a solid, in its own coordinates."""
    return Solid(MESH, np.zeros((1, 3)), np.eye(3), mesh_numbers(np.array(vertices, float), np.array(faces)))


def of(mesh: Any) -> Solid:
    """Return a mesh of the library as a solid."""
    return solid_of(mesh.vertices, mesh.faces)


def ell(depth: float = 0.5) -> Any:
    """Return an L, extruded along z: triangles by hand, so that its flat parts have seams."""
    n, base = len(ELL), [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    vertices = np.array([[*corner, z] for z in (0.0, depth) for corner in ELL])
    faces = [[c, b, a] for a, b, c in base] + [[a + n, b + n, c + n] for a, b, c in base]
    for k in range(n):
        a, b = k, (k + 1) % n
        faces += [[a, b, b + n], [a, b + n, a + n]]
    return trimesh.Trimesh(vertices, faces, process=False)


def found(one: Solid, x: Any) -> tuple[np.ndarray, ...]:
    """Return d, n, alpha, t at positions (N, 3)."""
    table = make_solids([one])
    each = [signed_distance(table, 0, tuple(p)) for p in np.asarray(x, float)]
    return tuple(np.array(part) for part in zip(*each, strict=True))


def in_box(one: Solid, x: np.ndarray) -> np.ndarray:
    """Return which positions lie in the box around a mesh, in its own coordinates, where its distance is exact."""
    corners, local = mesh_triangles(one).reshape(-1, 3), (x - one.points[0]) @ one.directions.T
    corners = (corners - one.points[0]) @ one.directions.T
    return ((local >= corners.min(axis=0)) & (local <= corners.max(axis=0))).all(axis=1)


@pytest.mark.parametrize("subdivided", [0, 2])
def test_a_cube_of_triangles_is_a_box(subdivided, rng):
    """Also beside its faces, edges and corners; points on its seams and under the corners of its triangles included."""
    mesh = trimesh.creation.box(2 * HALF)
    for _ in range(subdivided):
        mesh = mesh.subdivide()
    cube = of(mesh)
    box = Solid(BOX, np.zeros((1, 3)), np.eye(3), HALF)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.25, 1.25, 11)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = np.concatenate([rng.uniform(-1.3, 1.3, (1500, 3)), grid]) * HALF
    (d, n, alpha, _), (d_box, n_box, _, _) = found(cube, x), found(box, x)
    inside = d_box < 0
    assert inside.sum() > 500
    np.testing.assert_allclose(d[inside], d_box[inside], rtol=0, atol=1e-15)
    assert (d[~inside] <= d_box[~inside] + 1e-15).all()
    assert (d[d_box > 1e-12] > 0).all()
    assert (alpha[inside] == 0).all()
    sorted_ = np.sort(HALF - np.abs(x[inside]), axis=1)
    alone = sorted_[:, 1] - sorted_[:, 0] > 1e-9  # one face is the nearest, and not the opposite one as well
    alone &= (n_box[inside] * x[inside]).sum(axis=1) > 1e-9
    np.testing.assert_allclose(n[inside][alone], n_box[inside][alone], rtol=0, atol=1e-14)


def test_a_ball_of_triangles_is_a_ball_within_its_sag(rng):
    """The middle of an edge is the sag inside the ball."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    sag = 1 - np.linalg.norm(mesh.triangles_center, axis=1).min()
    ways = rng.normal(size=(400, 3))
    x = ways / np.linalg.norm(ways, axis=1)[:, None] * rng.uniform(0.2, 0.999, (400, 1))
    d, n, alpha, _ = found(of(mesh), x)
    radius = np.linalg.norm(x, axis=1)
    assert ((d - (radius - 1) >= -1e-14) & (d - (radius - 1) <= sag)).all()
    assert (alpha[d < 0] == 0).all()
    shallow = (d < 0) & (d > -0.1)
    assert (np.einsum("nd,nd->n", n, x / radius[:, None])[shallow] > 0.99).all()


SHAPES = {
    "L": ell,
    "torus": lambda: trimesh.creation.torus(0.5, 0.2, major_sections=12, minor_sections=9),
    "hollow": lambda: trimesh.util.concatenate(
        [trimesh.creation.box(2 * HALF), trimesh.Trimesh(*hollow_ball(), process=False)]
    ),
    "one tetrahedron": lambda: trimesh.Trimesh(np.eye(4)[:, :3], [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
}


def hollow_ball() -> tuple[np.ndarray, np.ndarray]:
    """Return a ball with its faces turned inward."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.12)
    return ball.vertices, ball.faces[:, ::-1]


@pytest.mark.parametrize("name", SHAPES)
def test_the_distance_is_that_of_the_nearest_triangle(name, rng):
    """The nearest point and the sign of another library, in the box around the mesh; outside of it a bound."""
    mesh = SHAPES[name]()
    low, high = mesh.bounds
    x = rng.uniform(low - 0.1, high + 0.1, (3000, 3))
    one = of(mesh)
    d = found(one, x)[0]
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    exact = igl.signed_distance(x, np.array(mesh.vertices), np.array(mesh.faces), kind)[0]
    near = in_box(one, x)
    assert near.sum() > 1000
    np.testing.assert_allclose(d[near], exact[near], rtol=0, atol=1e-14)
    assert ((d[~near] <= exact[~near] + 1e-14) & (d[~near] > 0)).all()


@pytest.mark.parametrize("name", SHAPES)
def test_the_normal_and_the_curvature_are_derivatives(name, rng):
    """Inside; a few points whose nearest triangle changes are excepted. Edges and corners that point in are curved."""
    mesh, h = SHAPES[name](), 1e-6
    low, high = mesh.bounds
    one, x = of(mesh), rng.uniform(low, high, (1500, 3))
    d, n, alpha, t = found(one, x)
    x, n, alpha, t = x[d < -1e-3], n[d < -1e-3], alpha[d < -1e-3], t[d < -1e-3]
    slope, turn = np.zeros(x.shape), np.zeros((*x.shape, 3))
    for axis, step in enumerate(h * np.eye(3)):
        (d_up, n_up, *_), (d_down, n_down, *_) = found(one, x + step), found(one, x - step)
        slope[:, axis], turn[:, :, axis] = (d_up - d_down) / (2 * h), (n_up - n_down) / (2 * h)
    flat = np.eye(3) - n[:, :, None] * n[:, None, :] - t[:, :, None] * t[:, None, :]
    wrong = np.abs(slope - n).max(axis=1) > 1e-7
    wrong |= np.abs(turn - alpha[:, None, None] * flat).max(axis=(1, 2)) > 1e-3
    assert len(x) > 20
    assert wrong.mean() < 2e-3
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, rtol=1e-14)
    curved = (alpha != 0) & (np.abs(t).max(axis=1) > 0), (alpha != 0) & (np.abs(t).max(axis=1) == 0)
    assert curved[0].any() == (name != "one tetrahedron")  # edges
    assert curved[1].any() == (name == "hollow")  # corners


@pytest.mark.parametrize("subdivided", [0, 1])
def test_an_l_is_curved_around_its_inner_edge_as_its_polygon_is(subdivided, rng):
    """Also exactly below the corners of triangles on that edge, and in the middle of seams."""
    mesh = ell()
    for _ in range(subdivided):
        mesh = mesh.subdivide()
    plate = Solid(POLYGON, np.zeros((1, 3)), np.eye(3)[:2], ELL.ravel())
    x = np.concatenate([rng.uniform([0.05, 0.05, 0], [0.4, 0.4, 0], (300, 3)), [[0.3, 0.3, 0], [0.3, 0.25, 0]]])
    x[:, 2] = 0.25  # the middle: a corner of triangles if subdivided
    deep = found(plate, x)[0] > -0.24  # no end of the prism is nearer
    for got, want in zip(found(of(mesh), x[deep]), found(plate, x[deep]), strict=True):
        sign = 1.0 if got.ndim == 1 or got.shape != (deep.sum(), 3) else np.sign((got * want).sum(axis=1))[:, None]
        curved = found(plate, x[deep])[2] != 0
        assert curved.sum() > 20
        np.testing.assert_allclose((sign * got)[curved], want[curved], rtol=1e-12, atol=1e-13)


def test_a_mesh_moves_with_its_place(rng):
    one, R = of(ell()), Rotation.from_rotvec([0.3, -0.7, 0.4]).as_matrix()
    x, offset = rng.uniform([0, 0, 0], [1, 1, 0.5], (300, 3)), np.array([3.0, -0.2, 0.3])
    placed = one.placed(1.7, R, offset).placed(0.5, TURNED, offset)
    at = offset + 0.5 * (offset + 1.7 * x @ R.T) @ TURNED.T
    (d, n, alpha, t), (d_at, n_at, alpha_at, t_at) = found(one, x), found(placed, at)
    np.testing.assert_allclose(d_at, 0.85 * d, rtol=0, atol=1e-14)
    np.testing.assert_allclose(n_at, n @ R.T @ TURNED.T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(alpha_at, alpha / 0.85, rtol=1e-9)
    np.testing.assert_allclose(t_at, t @ R.T @ TURNED.T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        np.sort(mesh_triangles(placed).reshape(-1, 3), axis=0),
        np.sort((offset + 0.5 * (offset + 1.7 * mesh_triangles(one) @ R.T) @ TURNED.T).reshape(-1, 3), axis=0),
        rtol=0, atol=1e-14,
    )  # fmt: skip


def test_faces_without_a_height_do_no_harm(rng):
    """A wedge of 20 degrees with corners of triangles on the middle of its edge: one face has them all on a line."""
    a = np.radians(20)
    tip = [[0, 0, 0], [0, 0, 1], [0, 0, 0.3]]
    vertices = np.array([*tip, [1, 0, 0], [1, 0, 1], [np.cos(a), np.sin(a), 0], [np.cos(a), np.sin(a), 1]], float)
    faces = [[0, 3, 4], [0, 4, 1], [0, 1, 2], [0, 2, 6], [0, 6, 5], [2, 1, 6], [0, 5, 3], [1, 4, 6], [3, 5, 6],
             [3, 6, 4]]  # fmt: skip
    kept = [[0, 3, 4], [0, 4, 1], [0, 1, 6], [0, 6, 5], [0, 5, 3], [1, 4, 6], [3, 5, 6], [3, 6, 4]]
    x = rng.uniform([-0.5, -0.5, 0.01], [0.9, 0.5, 0.99], (3000, 3))
    one, other = solid_of(vertices, faces), solid_of(vertices, kept)
    triangles = mesh_triangles(one)
    heights = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert len(triangles) == 10
    assert (np.linalg.norm(heights, axis=1) > 0.01).all()
    got, want = found(one, x), found(other, x)
    chosen = in_box(other, x)
    np.testing.assert_allclose(got[0][chosen], want[0][chosen], rtol=0, atol=1e-14)
    np.testing.assert_allclose(got[1][want[0] < 0], want[1][want[0] < 0], rtol=0, atol=1e-12)
    angle = np.arctan2(x[:, 1], x[:, 0])
    really = (angle > 0) & (angle < a) & (x[:, 0] < np.cos(a))
    assert ((got[0] < 0)[chosen] == really[chosen]).all()


def test_a_needle_has_exact_distances(rng):
    """Its triangles are 1e-7 of their length high, so normals from a plain product of edges would be wrong."""
    h = 1e-7
    turn = Rotation.from_rotvec([0.3, -0.7, 0.4]).as_matrix()
    mesh = trimesh.creation.box((1, h, 1))
    one = solid_of(mesh.vertices @ turn.T, mesh.faces)
    x = rng.uniform(-0.45, 0.45, (200, 3)) * [1, 0.5 * h, 1]
    d = found(one, x @ turn.T)[0]
    np.testing.assert_allclose(d, np.abs(x[:, 1]) - 0.5 * h, rtol=0, atol=1e-15)


def test_a_far_point_costs_no_search_and_gets_a_bound():
    ball, mesh = (
        Solid(CAPSULE, np.zeros((2, 3)), np.zeros((0, 3)), np.ones(1)),
        trimesh.creation.icosphere(subdivisions=2),
    )
    x = np.array([[3.0, 0, 0], [2, 2, 2], [0, 0, -1.5]])
    d, d_ball = found(of(mesh), x)[0], found(ball, x)[0]
    assert (d <= d_ball + 0.1).all()
    assert (d >= 0.3 * d_ball).all()

"""Every boundary condition that the registry knows: its law, its adjoint in each branch, what is chosen at kinks."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
import pytest

from cqrun.boundaries import condition as conditions
from cqrun.boundaries.condition import NodeNormals, project, project_all, project_all_vjp, project_vjp
from cqrun.boundaries.friction import SMOOTHING, Friction
from cqrun.boundaries.separate import Separate
from cqrun.boundaries.slip import Slip
from cqrun.boundaries.sticky import Sticky
from cqrun.numerics.compile import kernel
from cqrun.plugin import registry

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
EVERY = pytest.mark.parametrize("name", registry.plugins("boundary"))
DOT_PRODUCT = 1e-9
COEFFICIENT = 0.6


def unit(a: np.ndarray) -> np.ndarray:
    """Return a vector of length one along `a`."""
    return a / np.linalg.norm(a)


def make(cls: Any, normal: np.ndarray, coefficient: float = COEFFICIENT) -> Any:
    """Return a condition's kernel view, with a coefficient where it has one."""
    given = {"coefficient": coefficient} if "coefficient" in cls.model_fields else {}
    return cls(face="x_min", **given).kernel_condition(tuple(float(a) for a in normal))


def derivative(f: Any, h: float = 1e-3) -> tuple[float, float]:
    """Return f'(0) by Richardson's extrapolation, and how far apart its last two values lie."""
    table = [(f(s) - f(-s)) / (2 * s) for s in (h, h / 2, h / 4, h / 8)]
    previous = table[-1]
    for order in (4, 16, 64):
        previous = table[-1]
        table = [(order * b - a) / (order - 1) for a, b in itertools.pairwise(table)]
    return table[0], abs(table[0] - previous)


@EVERY
@DIM
def test_dot_product_inside_every_branch(name, dim, rng):
    """Random nodes; the few whose differences straddle a kink are left out, and counted."""
    cls, tried, still = registry.plugins("boundary")[name], 0, 0
    for _ in range(200):
        n, v, out_bar, v_dot = unit(rng.normal(size=dim)), *rng.normal(size=(3, dim))
        given, c_dot = make(cls, n), rng.normal()

        def along(h: float, given: Any = given, v: Any = v, v_dot: Any = v_dot, c_dot: float = c_dot,
                  out_bar: Any = out_bar) -> float:  # fmt: skip
            moved = given._replace(coefficient=given.coefficient + h * c_dot * (given.coefficient > 0))
            return float(np.dot(project(moved, tuple(v + h * v_dot)), out_bar))

        forward, doubt = derivative(along)
        if doubt > 1e-8:
            continue
        tried += 1
        still += not np.any(project(given, tuple(v)))
        v_bar, c_bar = project_vjp(given, tuple(v), tuple(out_bar))
        size = np.linalg.norm(out_bar) * np.linalg.norm(v_dot)
        assert np.dot(v_bar, v_dot) + c_bar * c_dot == pytest.approx(forward, rel=DOT_PRODUCT, abs=DOT_PRODUCT * size)
    assert tried > 180
    # half of the nodes leave; of the others, enough slide and enough are held
    assert name != "friction" or 10 <= still < 80


class _Strange(NamedTuple):
    normal: tuple[float, ...]
    coefficient: float


def test_a_condition_without_an_adjoint_fails(monkeypatch):
    strange = _Strange((1.0, 0.0), 0.0)
    monkeypatch.setitem(conditions._PROJECT.bodies, _Strange, (lambda condition, v: v, "condition, v"))
    assert project(strange, (1.0, 2.0)) == (1.0, 2.0)
    with pytest.raises(KeyError):
        project_vjp(strange, (1.0, 2.0), (1.0, 1.0))


# --- laws ------------------------------------------------------------------------------------------------


@DIM
def test_what_each_wall_does(dim, rng):
    n = unit(rng.normal(size=dim))
    along = rng.normal(size=dim)
    along -= along @ n * n
    into, out = along - 2 * n, along + 2 * n
    for v, separated in ((into, along), (out, out)):
        np.testing.assert_allclose(project(make(Sticky, n), tuple(v)), np.zeros(dim), atol=0)
        np.testing.assert_allclose(project(make(Slip, n), tuple(v)), along, atol=1e-15)
        np.testing.assert_allclose(project(make(Separate, n), tuple(v)), separated, atol=1e-15)
        np.testing.assert_allclose(project(make(Friction, n, 0.0), tuple(v)), separated, atol=1e-15)


@DIM
def test_friction_takes_its_share_of_the_normal_speed(dim, rng):
    """Sliding loses c |l_n| of tangential speed, along it; less than that is held; what leaves is left alone."""
    n = unit(rng.normal(size=dim))
    way = rng.normal(size=dim)
    way = unit(way - way @ n * n)
    for speed, left in ((3.0, 3.0 - 0.6 * 2.0), (1.1, 0.0)):
        got = project(make(Friction, n), tuple(speed * way - 2.0 * n))
        np.testing.assert_allclose(got, left * way, atol=2 * SMOOTHING)
    leaving = 3.0 * way + 2.0 * n
    np.testing.assert_allclose(project(make(Friction, n), tuple(leaving)), leaving, atol=1e-15)


@DIM
def test_friction_at_rest_has_a_derivative(dim):
    """Both papers' sqrt(|v_t|^2 + eps): at v_t = 0 nothing is divided by zero."""
    n = np.eye(dim)[-1]
    out = project(make(Friction, n), tuple(-1.0 * n))
    v_bar, c_bar = project_vjp(make(Friction, n), tuple(-1.0 * n), (1.0,) * dim)
    assert np.all(np.isfinite([*out, *v_bar, c_bar]))


# --- kinks: the branch of H(x) = [x >= 0] ----------------------------------------------------------------


def jacobian(condition: Any, v: np.ndarray) -> np.ndarray:
    """Return d project / d (v, coefficient) as the adjoint has it, (D, D + 1)."""
    rows = [project_vjp(condition, tuple(v), tuple(e)) for e in np.eye(len(v))]
    return np.array([[*v_bar, c_bar] for v_bar, c_bar in rows])


def one_sided(condition: Any, v: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Return d project / d (v, coefficient) just beside v, where no kink is, (D, D + 1)."""
    v, dim = v + 1e-5 * towards, len(v)
    columns = []
    for k in range(dim + 1):
        step = np.eye(dim + 1)[k]

        def moved(h: float, step: np.ndarray = step) -> np.ndarray:
            changed = condition._replace(coefficient=condition.coefficient + h * step[-1])
            return np.array(project(changed, tuple(v + h * step[:-1])))

        h = 1e-7
        columns.append((moved(h) - moved(-h)) / (2 * h))
    return np.array(columns).T


@DIM
@pytest.mark.parametrize("cls", [Separate, Friction], ids=["separate", "friction"])
def test_a_node_that_only_touches_counts_as_leaving(cls, dim, rng):
    """At v . n = 0 exactly the derivative is that of v . n > 0: the node is free."""
    n, v = np.eye(dim)[-1], np.append(rng.normal(size=dim - 1), 0.0)
    chosen = jacobian(make(cls, n), v)
    np.testing.assert_allclose(chosen[:, :dim], np.eye(dim), atol=1e-6)
    np.testing.assert_allclose(chosen[:, dim], 0.0, atol=1e-12)
    np.testing.assert_allclose(chosen, one_sided(make(cls, n), v, n), atol=1e-4)
    # and the other side is another derivative
    assert np.abs(chosen - one_sided(make(cls, n), v, -n)).max() > 0.5


@DIM
def test_a_node_that_just_stops_counts_as_sliding(dim):
    """At l_t = c |l_n| exactly the derivative is that of a node that still slides."""
    n, way = np.eye(dim)[-1], np.eye(dim)[0]
    l_n = -2.0
    v = way + l_n * n
    speed = np.sqrt(1.0 + SMOOTHING)
    grips = make(Friction, n, speed / 2.0)  # exact: division by a power of two
    assert speed + grips.coefficient * l_n == 0.0
    np.testing.assert_array_equal(project(grips, tuple(v)), np.zeros(dim))
    chosen = jacobian(grips, v)
    np.testing.assert_allclose(chosen, one_sided(grips, v, way), atol=1e-3)
    # d out_x / d v_x = 1, / d v_n = c, / d c = l_n
    np.testing.assert_allclose(chosen[0], [1.0, *[0.0] * (dim - 2), grips.coefficient, l_n], atol=1e-6)
    np.testing.assert_allclose(one_sided(grips, v, -way), 0.0, atol=1e-12)


# --- several conditions at one node, compiled ------------------------------------------------------------


@kernel
def walls_2d(conditions, held, v, out_bar, out, v_bar, c_bar):
    for i in range(len(v)):
        at, bar = (v[i, 0], v[i, 1]), (out_bar[i, 0], out_bar[i, 1])
        out[i, 0], out[i, 1] = project_all(conditions, i, held[i], at)
        v_bar[i, 0], v_bar[i, 1] = project_all_vjp(conditions, i, held[i], at, bar, c_bar, 0)


@kernel
def walls_3d(conditions, held, v, out_bar, out, v_bar, c_bar):
    for i in range(len(v)):
        at, bar = (v[i, 0], v[i, 1], v[i, 2]), (out_bar[i, 0], out_bar[i, 1], out_bar[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = project_all(conditions, i, held[i], at)
        v_bar[i, 0], v_bar[i, 1], v_bar[i, 2] = project_all_vjp(conditions, i, held[i], at, bar, c_bar, 0)


@pytest.mark.parametrize(("dim", "walls"), [(2, walls_2d), (3, walls_3d)], ids=["2D", "3D"])
def test_compiled_walls_in_every_combination(dim, walls, rng):
    """Bit k of a node's mask is condition k; they act in order, each on what the one before left.

    The last is terrain, with a normal of its own at every node.
    """
    known = registry.plugins("boundary").values()
    given = tuple(make(cls, unit(rng.normal(size=dim))) for cls in known)
    n = 8 * 2 ** (len(given) + 1)
    slopes = np.array([unit(rng.normal(size=dim)) for _ in range(n)])
    given += (Friction(face="x_min", coefficient=0.7).kernel_condition(NodeNormals(slopes, (0,) * dim)),)
    held, (v, out_bar) = np.tile(np.arange(2 ** len(given)), 8), rng.normal(size=(2, n, dim))
    out, v_bar, c_bar = np.zeros((n, dim)), np.zeros((n, dim)), np.zeros(len(given))
    walls(given, held, v, out_bar, out, v_bar, c_bar)
    c_want = np.zeros(len(given))
    for i in range(n):
        trail, here = [tuple(v[i])], [*given[:-1], make(Friction, slopes[i], 0.7)]
        for k, one in enumerate(here):
            trail.append(project(one, trail[-1]) if held[i] >> k & 1 else trail[-1])
        bar = tuple(out_bar[i])
        np.testing.assert_allclose(out[i], trail[-1], atol=1e-14)
        for k in reversed(range(len(given))):
            if held[i] >> k & 1:
                bar, c = project_vjp(here[k], trail[k], bar)
                c_want[k] += c
        np.testing.assert_allclose(v_bar[i], bar, atol=1e-13)
        mine = np.zeros(len(given))
        again = project_all_vjp(given, i, int(held[i]), tuple(v[i]), tuple(out_bar[i]), mine, 0)
        np.testing.assert_allclose(again, bar, atol=1e-14)
        np.testing.assert_allclose(project_all(given, i, int(held[i]), tuple(v[i])), trail[-1], atol=0)
    np.testing.assert_allclose(c_bar, c_want, atol=1e-12)


# --- places ----------------------------------------------------------------------------------------------


def nodes(dim: int, count: int = 11) -> np.ndarray:
    """Return nodes .1 m apart, one beyond each face of a world of .9 m."""
    axes = [np.arange(-1, count) * 0.1] * dim
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, dim)


@DIM
@pytest.mark.parametrize("end", ["min", "max"])
def test_a_face_holds_the_nodes_at_and_beyond_it(dim, end):
    at, size = nodes(dim), np.full(dim, 0.9)
    for axis in range(dim):
        [(held, normal)] = Slip(face="xyz"[axis] + "_" + end).places(at, size)
        beyond = at[:, axis] < 0.05 if end == "min" else at[:, axis] > 0.85
        np.testing.assert_array_equal(held, beyond)
        np.testing.assert_array_equal(normal, np.eye(dim)[axis] * (1 if end == "min" else -1))
        [(deep, _)] = Slip(face="xyz"[axis] + "_" + end, thickness=0.2).places(at, size)
        depth = at[:, axis] if end == "min" else 0.9 - at[:, axis]
        np.testing.assert_array_equal(deep, depth < 0.25)


@DIM
def test_all_faces_are_one_plane_each(dim):
    planes = Friction(face="all", coefficient=0.3).places(nodes(dim), np.full(dim, 0.9))
    assert len(planes) == 2 * dim
    assert len({normal for _, normal in planes}) == 2 * dim


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "give exactly one of `face` and `region`"),
        ({"face": "x_min", "normal": [1.0, 0.0]}, "`normal` belongs to a region"),
        ({"region": {"box": {"corner": [0.0, 0.0], "size": [1.0, 1.0]}}}, "needs `normal`, a unit vector, for slip"),
        (
            {"region": {"half_space": {"point": [0.0, 0.2], "normal": [0.0, 1.0]}}, "thickness": 0.1},
            "`thickness` belongs to a face; a region has its own size",
        ),
        (
            {"region": {"box": {"corner": [0.0, 0.0], "size": [1.0, 1.0]}}, "normal": [1.0, 1.0]},
            "`normal` must have length 1",
        ),
    ],
)
def test_places_that_make_no_sense_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Slip.model_validate(given)


def test_a_half_space_brings_its_normal_and_sticky_needs_none():
    slope = {"half_space": {"point": [0.0, 0.3], "normal": [0.6, 0.8]}}
    at = nodes(2)
    [(held, normal)] = Slip.model_validate({"region": slope}).places(at, np.full(2, 0.9))
    np.testing.assert_allclose(normal, [0.6, 0.8])
    inside = (at - [0.0, 0.3]) @ [0.6, 0.8]
    clear = np.abs(inside) > 1e-9
    np.testing.assert_array_equal(held[clear], inside[clear] < 0)
    box = {"box": {"corner": [0.0, 0.0], "size": [0.25, 0.25]}}
    [(held, _)] = Sticky.model_validate({"region": box}).places(at, np.full(2, 0.9))
    assert held.sum() == 9


def test_terrain_gives_every_node_the_normal_of_its_place():
    """The region of a height field: nodes below it, each with the normal of the slope above it."""
    hills = {"sinusoid": {"amplitude": 0.1, "wavelength": 0.6, "base": 0.4}}
    ground = Friction.model_validate({"region": {"height_field": hills}, "coefficient": 0.5})
    at, size = nodes(2), np.full(2, 0.9)
    ((held, normals),) = ground.places(at, size)
    height = 0.4 + 0.1 * np.sin(2 * np.pi * at[:, 0] / 0.6)
    np.testing.assert_array_equal(held, at[:, 1] <= height + 1e-9)  # nodes on the surface, too
    slope = 0.1 * 2 * np.pi / 0.6 * np.cos(2 * np.pi * at[:, 0] / 0.6)
    np.testing.assert_allclose(normals[:, 0] / normals[:, 1], -slope, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)

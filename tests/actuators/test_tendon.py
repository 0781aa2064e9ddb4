"""Tendons that rub, and spools: momentum, the capstan's law, adjoints and products of the tangent beside each kink."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from cqrun.actuators.tendon import Line, SpoolKernel, TendonKernel, tendon_constants, wind, wind_jvp, wind_vjp
from cqrun.forces.force import ACTIVATION, FRICTION, REST, STRENGTH, Kind, Levels, is_unsymmetric, make_forces
from cqrun.numerics.packed import pack
from cqrun.state import PADDING

DOT_PRODUCT, DIFFERENCE = 1e-9, 1e-8
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
LAW = pytest.mark.parametrize("by_length", [False, True], ids=["tension", "length"])
POINTS = 6, 4
LEVELS = {ACTIVATION: 0.7, STRENGTH: 2.0, REST: 0.3, FRICTION: 0.4}


def packed(rows: np.ndarray) -> np.ndarray:
    table = np.zeros((len(rows), -(-rows.shape[1] // PADDING) * PADDING))
    table[:, : rows.shape[1]] = rows
    return pack(table, np.float64)


class Spool:
    """Two routes on one spool, wound in opposite ways, through points of their own."""

    def __init__(self, dim: int, by_length: bool, kernel: type = TendonKernel) -> None:
        begins = (0.1, 2.1) if by_length else (0.0, 0.0)
        lines = [Line(n, begin, sign) for n, begin, sign in zip(POINTS, begins, (1.0, -1.0), strict=True)]
        part = Kind(kernel, np.zeros(1, np.int64), [np.arange(sum(POINTS))], [tendon_constants(by_length, lines)])
        (self.kernel,), self.shares = make_forces([part], dim)
        self.dim = dim

    def _levels(self, changed: dict[int, float]) -> Levels:
        u, strength, rest, friction = (np.array([value]) for value in (LEVELS | changed).values())
        return Levels(u[None], strength, rest, friction)

    def _at_points(self, shares: np.ndarray) -> np.ndarray:
        out = np.zeros((sum(POINTS), self.dim))
        np.add.at(out, self.shares.columns, shares)
        return out

    def _q(self, x: np.ndarray) -> np.ndarray:
        return packed(np.concatenate([x.T, 0.0 * x.T]))

    def force(self, x: np.ndarray, changed: dict[int, float] | None = None) -> np.ndarray:
        wind(self.kernel, 0, self._levels(changed or {}), 0, self._q(x))
        return self._at_points(self.shares.force)

    def vjp(self, x: np.ndarray, bar: np.ndarray, changed: dict[int, float]) -> tuple[np.ndarray, np.ndarray]:
        wind_vjp(self.kernel, 0, self._levels(changed), 0, self._q(x), packed(bar.T))
        return self._at_points(self.shares.x_bar), self.shares.level_bar[0].copy()

    def jvp(self, x: np.ndarray, move: np.ndarray, changed: dict[int, float]) -> np.ndarray:
        wind_jvp(self.kernel, 0, self._levels(changed), 0, self._q(x), packed(move.T))
        return self._at_points(self.shares.x_bar)


def slope(function: Callable[[float], np.ndarray], h: float) -> np.ndarray:
    """Return a central difference of order 4."""
    return (function(-2 * h) - 8 * function(-h) + 8 * function(h) - function(2 * h)) / (12 * h)


ACTIVATIONS = pytest.mark.parametrize("u", [0.7, -0.4, 1.3, 2.2])
"""Of a tension, on both sides of zero; of a length, with all of them taut, and slack at one end or the other."""


@DIM
@LAW
@ACTIVATIONS
def test_it_adds_no_momentum(dim, by_length, u, rng):
    x = rng.normal(size=(sum(POINTS), dim))
    f = Spool(dim, by_length).force(x, {ACTIVATION: u})
    assert np.abs(f).max() > 0.1
    np.testing.assert_allclose(f.sum(axis=0), 0.0, atol=1e-13)
    moments = [x[:, i] * f[:, j] - x[:, j] * f[:, i] for i, j in itertools.combinations(range(dim), 2)]
    np.testing.assert_allclose(np.sum(moments, axis=1), 0.0, atol=1e-13)


@DIM
@LAW
@ACTIVATIONS
def test_products_of_the_tangent_and_adjoints(dim, by_length, u, rng):
    spool, changed = Spool(dim, by_length), {ACTIVATION: u}
    x, move, bar = (rng.normal(size=(sum(POINTS), dim)) for _ in range(3))
    change = spool.jvp(x, move, changed)
    wanted = slope(lambda h: spool.force(x + h * move, changed), 1e-4)
    np.testing.assert_allclose(change, wanted, rtol=0, atol=DIFFERENCE * np.abs(wanted).max())
    x_bar, level_bar = spool.vjp(x, bar, changed)
    assert (bar * change).sum() == pytest.approx((x_bar * move).sum(), rel=DOT_PRODUCT)
    for level, value in (LEVELS | changed).items():
        found = slope(lambda h, k=level, v=value: spool.force(x, changed | {k: v + h}), 1e-3)
        assert level_bar[level] == pytest.approx((bar * found).sum(), rel=DIFFERENCE, abs=1e-11)


@DIM
def test_its_tangent_is_symmetric_only_without_friction(dim, rng):
    spool = Spool(dim, True)
    x, a, b = (rng.normal(size=(sum(POINTS), dim)) for _ in range(3))
    for friction, same in ((0.0, True), (0.4, False)):
        products = [(p * spool.jvp(x, q, {FRICTION: friction})).sum() for p, q in ((a, b), (b, a))]
        assert (products[0] == pytest.approx(products[1], rel=1e-12)) == same
    assert is_unsymmetric(TendonKernel)
    assert not is_unsymmetric(SpoolKernel)


@DIM
@LAW
def test_without_friction_both_kernels_are_the_same(dim, by_length, rng):
    x = rng.normal(size=(sum(POINTS), dim))
    forces = [Spool(dim, by_length, kernel).force(x, {FRICTION: 0.0}) for kernel in (TendonKernel, SpoolKernel)]
    np.testing.assert_array_equal(*forces)


@pytest.mark.parametrize("mu", [0.0, 0.2, 0.5])
def test_after_each_bend_the_tension_is_that_of_a_capstan(mu):
    """A square: three right angles, of which the second turns back."""
    x = np.array([[0, 0], [1, 0], [1, 1], [2, 1], [2, 2], [3, 2], [9, 9], [9, 8], [9, 7], [9, 6]], float)
    f = Spool(2, False).force(x, {FRICTION: mu, ACTIVATION: 1.0})
    after = 2.0 * np.exp(-mu * 0.5 * np.pi * np.arange(5))
    np.testing.assert_allclose(f[0], [2.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(f[5], [-after[4], 0.0], atol=1e-14)
    np.testing.assert_allclose(f[1], [-after[0], after[1]], atol=1e-14)
    np.testing.assert_array_equal(f[6:], 0.0)  # wound the other way: slack


@DIM
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_beside_a_straight_line_the_derivative_is_that_of_its_side(dim, side, rng):
    """The angle has a kink where a route is straight: its derivative turns around, and is zero there."""
    x = np.zeros((sum(POINTS), dim))
    x[:, 0] = np.arange(sum(POINTS))
    spool, bar = Spool(dim, False), rng.normal(size=x.shape)
    move = np.zeros(x.shape)
    move[1, 1] = 1.0
    straight, beside = (spool.vjp(at, bar, {})[0] for at in (x, x + 1e-7 * side * move))
    assert np.isfinite(straight).all()
    by_hand = slope(lambda h: (bar * spool.force(x + (side * 1e-3 + h) * move)).sum(), 1e-5)
    near = spool.vjp(x + side * 1e-3 * move, bar, {})[0]
    assert (near * move).sum() == pytest.approx(by_hand, rel=1e-7)
    assert (beside * move).sum() == pytest.approx((near * move).sum(), abs=1e-2)
    assert abs((beside * move).sum() - (straight * move).sum()) > 0.1


@DIM
def test_just_taut_and_just_wound_the_derivative_is_that_of_a_tendon_that_pulls(dim, rng):
    x, bar = np.zeros((sum(POINTS), dim)), rng.normal(size=(sum(POINTS), dim))
    x[: POINTS[0], 0] = np.arange(POINTS[0])
    x[: POINTS[0], 1] = [0, 0.1, 0, 0.2, 0, 0]
    length = float(np.linalg.norm(np.diff(x[: POINTS[0]], axis=0), axis=1).sum())
    taut = Spool(dim, True)
    at = {ACTIVATION: 0.9, REST: length}  # begin + turn u is 1
    beside = {ACTIVATION: 0.9 - 1e-9, REST: length}
    assert np.abs(taut.force(x, at)).max() < 1e-14
    first = taut.vjp(x, bar, beside)[1]
    np.testing.assert_allclose(taut.vjp(x, bar, at)[1][[ACTIVATION, REST]], first[[ACTIVATION, REST]], rtol=1e-7)
    assert abs(first[REST]) > 0.1
    wound = Spool(dim, False)
    zero, more = wound.vjp(x, bar, {ACTIVATION: 0.0})[1], wound.vjp(x, bar, {ACTIVATION: 1e-9})[1]
    assert zero[ACTIVATION] == pytest.approx(more[ACTIVATION], rel=1e-7)
    assert abs(zero[ACTIVATION]) > 0.1
    assert wound.vjp(x, bar, {ACTIVATION: -1e-9})[1][ACTIVATION] == 0.0

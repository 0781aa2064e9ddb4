"""Unknowns as one vector, with fields and mirrored particles among them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cqrun.design.params import Block, Follower, Params, Plain, Spread
from cqrun.design.spread import field, mirrored_field, pairs, partners, shifted
from cqrun.errors import UsageError

X = np.stack(np.meshgrid(np.arange(9.0), np.arange(4.0), indexing="ij"), axis=-1).reshape(-1, 2)
MAPS = {"field": field(X, 3), "mirrored field": mirrored_field(X, 3, 0), "pairs": pairs(partners(X, 1, "particles"))}


@pytest.fixture(params=[(name, log) for name in MAPS for log in (False, True)], ids=str)
def params(request):
    """Return unknowns: a single number, and one that is spread over 36 particles."""
    name, log = request.param
    block = Spread("b", 2.0, 50.0, log, np.full(36, 10.0), MAPS[name])
    return Params((Block("a", 1.0, 3.0, False, np.array(1.5)), block))


@pytest.fixture
def regularised(params):
    """Return the same unknowns, each with a regulariser."""
    return Params(tuple(replace(b, regulariser=w) for b, w in zip(params.blocks, (0.3, 2.0), strict=True)))


def test_start_gives_the_initial_values(params):
    values = params.unpack(params.start)
    assert values["a"] == 1.5
    np.testing.assert_allclose(values["b"], 10.0, rtol=1e-14)
    assert len(params.start) == 1 + params.blocks[1].size < 37


def test_gradient_agrees_with_finite_differences(params, rng):
    n = len(params.start)
    x, direction = rng.uniform(0.2, 0.8, n), rng.normal(size=n)
    bars = {"a": rng.normal(), "b": rng.normal(size=36)}

    def product(at):
        values = params.unpack(at)
        return float(bars["a"] * values["a"] + bars["b"] @ values["b"])

    h = 1e-3
    ahead, behind = ([product(x + k * h * direction) for k in ks] for ks in ((1, 2), (-1, -2)))
    slope = (8 * (ahead[0] - behind[0]) - (ahead[1] - behind[1])) / (12 * h)
    assert params.gradient(x, bars) @ direction == pytest.approx(slope, rel=1e-9)


def test_regulariser_is_the_mean_squared_scaled_change(params, regularised):
    assert not params.regularised
    assert params.departure(params.unpack(params.start)) == 0.0
    assert regularised.departure(regularised.unpack(regularised.start)) == pytest.approx(0.0, abs=1e-28)
    moved = regularised.unpack(regularised.start + 0.1)
    assert regularised.departure(moved) == pytest.approx(0.3 * 0.1**2 + 2.0 * 0.1**2, rel=1e-9)


def test_gradient_of_the_regulariser_agrees_with_finite_differences(regularised, rng):
    x, direction = (draw(size=len(regularised.start)) for draw in (rng.random, rng.normal))
    x = 0.2 + 0.6 * x

    def departure(at):
        return 1.7 * regularised.departure(regularised.unpack(at))

    h = 1e-3
    ahead, behind = ([departure(x + k * h * direction) for k in ks] for ks in ((1, 2), (-1, -2)))
    slope = (8 * (ahead[0] - behind[0]) - (ahead[1] - behind[1])) / (12 * h)
    gradient = regularised.gradient(x, regularised.departure_vjp(regularised.unpack(x), 1.7))
    assert gradient @ direction == pytest.approx(slope, rel=1e-9)


def test_regulariser_of_a_single_number_for_all_particles(regularised):
    """From Python a single number may be given for all particles."""
    block = regularised.blocks[1]
    value, h = np.array(0.5 * (block.lower + block.upper)), 1e-3
    slope = (block.departure(value + h) - block.departure(value - h)) / (2 * h)
    assert np.shape(block.departure_vjp(value, 1.0)) == ()
    assert block.departure_vjp(value, 1.0) == pytest.approx(slope, rel=1e-6)


def test_values_keep_the_bounds_and_initial_values_can_be_packed(params, rng):
    values = params.unpack(rng.uniform(0.0, 1.0, len(params.start)))
    assert np.all((values["b"] >= 2.0) & (values["b"] <= 50.0))
    start = params.unpack(params.start)
    np.testing.assert_allclose(params.unpack(params.pack(start))["b"], start["b"], rtol=1e-12)


def test_physical_gives_numbers_in_the_unit_of_the_unknown(params, rng):
    x = rng.uniform(0.0, 1.0, len(params.start))
    numbers = params.physical(x)
    assert numbers.shape == x.shape
    assert np.all((numbers[1:] >= 2.0) & (numbers[1:] <= 50.0))


@pytest.mark.parametrize("order", [None, np.random.default_rng(1).permutation(36)], ids=["same order", "permuted"])
def test_gradient_includes_followers(order, rng):
    tie = Follower("c", -2.0, 5.0, order)
    params = Params((Block("b", 2.0, 50.0, True, np.full(36, 10.0), followers=(tie,)),))
    x, direction = rng.uniform(0.2, 0.8, 36), rng.normal(size=36)
    values = params.unpack(x)
    np.testing.assert_array_equal(values["c"], 5.0 - 2.0 * values["b"][slice(None) if order is None else order])
    bars = {path: rng.normal(size=36) for path in values}

    def product(h):
        return float(sum(bars[path] @ value for path, value in params.unpack(x + h * direction).items()))

    h = 1e-3
    slope = (8 * (product(h) - product(-h)) - (product(2 * h) - product(-2 * h))) / (12 * h)
    assert params.gradient(x, bars) @ direction == pytest.approx(slope, rel=1e-9)


def test_shifted_and_permuted_points_are_matched(rng):
    order = rng.permutation(len(X))
    np.testing.assert_array_equal(X[shifted(X, X[order] + 3.0, "particles", "of 'a'")], X[order])
    with pytest.raises(UsageError, match="the 35 particles are not the 36 of 'a' in another place"):
        shifted(X, X[1:], "particles", "of 'a'")


def test_bounds_in_words_lists_blocks():
    numbers, weights = np.full(3, 10.0), np.zeros(2)
    params = Params((
        Block("e", 5.0, 20.0, False, numbers), Block("nu", 0.2, 0.4, False, np.array(0.3)),
        Plain("w", np.array([-1.0, -2.0]), np.inf, False, weights),
    ))  # fmt: skip
    below = np.array([True, False, False, False, False, True])
    above = np.array([False, True, True, True, False, False])
    words = "at their bounds: e (1 of 3 at the lower, 5; 2 of 3 at the upper, 20), nu (at the upper, 0.4), "
    assert params.bounds_in_words(below, above) == words + "w (1 of 2 at the lower)"
    assert params.bounds_in_words(~above & False, ~above & False) == "no unknown is at a bound"

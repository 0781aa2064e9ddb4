"""Smooth fields and mirrored bodies: rows of their maps sum to 1, and their symmetry."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.design.spread import field, group_partners, mirrored, mirrored_field, pairs, partners
from cqrun.errors import UsageError


@pytest.fixture(params=[2, 3], ids=["2D", "3D"])
def points(request, rng):
    """Return random points in a box that is twice as long as high."""
    return rng.random((200, request.param)) * [2.0, 1.0, 0.5][: request.param] + 3.0


def test_rows_sum_to_one_without_negative_entries(points):
    S = field(points, 6)
    np.testing.assert_allclose(S.sum(axis=1), 1.0, rtol=1e-14)
    assert S.min() >= 0.0
    assert S.shape == (200, 8 * 5 * (4 if points.shape[1] == 3 else 1))


def test_values_keep_the_bounds_of_the_numbers(points, rng):
    S = field(points, 4)
    values = S @ rng.uniform(2.0, 5.0, S.shape[1])
    assert 2.0 <= values.min() < values.max() <= 5.0


def test_field_can_be_any_linear_function(points):
    S = field(points, 5).toarray()
    linear = points @ np.arange(1.0, points.shape[1] + 1)
    numbers, *_ = np.linalg.lstsq(S, linear, rcond=None)
    np.testing.assert_allclose(S @ numbers, linear, rtol=1e-10)


def test_field_is_continuously_differentiable():
    """Its slope does not jump: second differences are of the order of the square of the point distance."""
    rng = np.random.default_rng(3)
    line = np.stack([np.linspace(0.0, 1.0, 4001), np.zeros(4001)], axis=1)
    values = field(line, 5) @ rng.normal(size=field(line, 5).shape[1])
    slopes = np.diff(values) * 4000
    assert np.abs(np.diff(slopes)).max() < 0.1
    assert np.ptp(slopes) > 1.0


def test_field_over_a_single_point():
    np.testing.assert_allclose(field(np.array([[0.3, 0.4]]), 4).sum(axis=1), 1.0)


def test_mirrored_field_is_symmetric(points, rng):
    whole = np.concatenate([points, mirrored(points, 0)])
    S = mirrored_field(whole, 5, 0)
    values = S @ rng.normal(size=S.shape[1])
    np.testing.assert_allclose(values[:200], values[200:], rtol=1e-12)
    np.testing.assert_allclose(S.sum(axis=1), 1.0, rtol=1e-14)


def test_pairs_of_a_lattice():
    x = np.stack(np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 2)
    P = pairs(partners(x, 0, "particles")).toarray()
    assert P.shape == (6, 4)  # two pairs, and two points on the middle plane
    np.testing.assert_array_equal(P.sum(axis=1), 1.0)
    for k, place in enumerate(x):
        twin = int(np.flatnonzero(np.all(x == [2.0 - place[0], place[1]], axis=1))[0])
        np.testing.assert_array_equal(P[k], P[twin])


def test_body_without_symmetry_is_an_error():
    x = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    words = r"1 of 4 particles of 'arm' have no mirror image across x, the first at \(2, 1\) m: symmetry needs"
    with pytest.raises(UsageError, match=words):
        partners(x, 0, "particles of 'arm'")


def test_groups_are_mirrored_by_their_particles():
    x = np.stack(np.meshgrid(np.arange(8.0), np.arange(3.0), indexing="ij"), axis=-1).reshape(-1, 2)
    partner, column = partners(x, 0, "particles"), x[:, 0]
    groups = {"left": column < 3, "right": column > 4, "middle": (column == 3) | (column == 4)}
    np.testing.assert_array_equal(group_partners(groups, partner, 0, "'arm'"), [1, 0, 2])
    beside = {"left": column < 3, "next": (column > 2) & (column < 6)}
    with pytest.raises(UsageError, match="2 of 2 groups of 'arm' have no mirror image across x: left, next; "):
        group_partners(beside, partner, 0, "'arm'")
    with pytest.raises(UsageError, match="2 of 2 groups of 'arm' have no mirror image across x"):
        group_partners({"left": column < 3, "right": column > 5}, partner, 0, "'arm'")

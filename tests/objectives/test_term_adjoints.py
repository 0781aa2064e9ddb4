"""Every registered objective: its adjoint checked by complex step, for every reduction and side of a kink."""

from __future__ import annotations

import typing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_matter import CONTROL_STEP, N_ACTUATORS, N_CONTROLS, STEP, box_around_left, made_matter, moved, slope
from made_tracks import a_track, adjoint_error

from cqrun.objectives.gaps import lengths, lengths_vjp
from cqrun.objectives.term import BoundTerm, Objective, Over, reduced, reduced_vjp
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.registry import plugins

OVER = typing.get_args(Over)


def examples(dim: int) -> dict[str, list[dict[str, Any]]]:
    """Return fields for each plug-in to test; tracks have centroids within about 1 m of the origin."""
    path = [[0.02, 0.1, 0.2, 0.3][: dim + 1], [0.11, 0.4, -0.2, 0.1][: dim + 1], [0.2, 0.5, 0.5, 0.5][: dim + 1]]
    return {
        "distance": [{"body": "arm"}, {"body": "arm", "group": "tip", "axis": "y"}],
        "reach": [
            {"body": "arm", "group": "tip", "goal": "target"},
            {"body": "arm", "position": [0.6, 0.7, 0.8][:dim], "squared": False},
            {"body": "arm", "target": "ball"},
            {"body": "ball", "target": "arm", "target_group": "left", "squared": False},
        ],
        "rest": [{"body": "arm"}, {"body": "arm", "group": "tip", "particles": True}],
        "effort": [{}, {"counted_from": "neutral"}],
        "mass": [{"body": "arm"}, {"body": "arm", "group": "tip"}],
        "volume": [{"body": "ball"}],
        "unchanged": [
            {"body": "arm"}, {"body": "arm", "group": "tip", "of": "mass"}, {"body": "ball", "of": "volume"},
            {"body": "arm", "of": "density"}, {"body": "ball", "of": "poissons_ratio"},
        ],
        "stretch": [{"body": "arm"}, {"body": "arm", "region": box_around_left(dim), "power": 2}, {"body": "ball",
                     "power": 4096}],
        "stiffness": [{"body": "arm"}, {"body": "arm", "group": "left"}],
        "track": [{"body": "arm", "path": path}, {"body": "arm", "keys": path}, {"body": "arm", "keys": path[:1],
                   "squared": False}, {"body": "arm", "group": "tip", "marker": {"file": "wave.csv", "marker": "tip"}}],
        "reaction": [
            {"boundary": "clamp"}, {"boundary": "floor", "component": "y", "on": "boundary"},
            {"boundary": "clamp", "of": "moment"}, {"boundary": "clamp", "of": "moment", "component": "z"},
        ],
        "reaction_track": [
            {"boundary": "floor", "component": "x", "path": [[0.02, 1.0], [0.2, -1.0]]},
            {"boundary": "clamp", "of": "moment", "component": "z", "on": "boundary", "path": [[0.0, 0.3]]},
        ],
        "measured": [
            {"quantity": "tip", "component": "y"}, {"quantity": "tip"},
            {"quantity": "tip", "target": [0.1, 0.2, 0.3][:dim]}, {"quantity": "gap", "target": 0.3},
            {"quantity": "cable"}, {"quantity": "held", "component": "x"},
            {"quantity": "energy"},
        ],
        "hold": [
            {"rigid": "stone"}, {"rigid": "stone", "by": "jaw", "begin": 0.1},
            {"rigid": "stone", "body": "arm", "group": "tip", "end": 0.15, "squared": False},
        ],
        "lift": [  # on both sides of the height
            {"rigid": "stone", "height": 9.0}, {"rigid": "stone", "height": 0.0, "axis": "x", "begin": 0.1},
        ],
        "height": [{"body": "arm", "group": "tip"}, {"body": "ball", "axis": "x"}],
        "contact_free": [
            {"body": "arm", "height": 0.1, "margin": 0.2},  # about half of the particles are too deep
            {"body": "arm", "region": box_around_left(dim), "height": 9.0, "axis": "x"},  # all are
            {"body": "arm", "height": -9.0},  # none is
        ],
    }  # fmt: skip


CASES = [(name, k) for name, tried in examples(2).items() for k in range(len(tried))]
EVERY = pytest.mark.parametrize(("name", "k"), CASES, ids=[f"{name}{k}" for name, k in CASES])
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])


def make(name: str, k: int, dim: int, **fields: Any) -> BoundTerm:
    spec = plugins("objective")[name].model_validate(examples(dim)[name][k] | fields)
    bound: BoundTerm = spec.bind(made_matter(dim))
    return bound


def test_every_objective_has_an_example():
    assert set(examples(2)) == set(plugins("objective"))


@EVERY
@DIM
@pytest.mark.parametrize("over", OVER)
def test_dot_product(name, k, dim, over, rng):
    bound = make(name, k, dim, over=over)
    assert bound.over == over
    track = a_track(bound.rows.shape[0], dim, rng)
    assert adjoint_error(bound.value, bound.value_vjp, track, rng) <= 1e-9


@DIM
@pytest.mark.parametrize("k", range(3))
def test_dot_product_of_the_smooth_maximum_over_time(k, dim, rng):
    bound = make("stretch", k, dim)
    assert bound.over == "smooth_maximum"
    assert adjoint_error(bound.value, bound.value_vjp, a_track(bound.rows.shape[0], dim, rng), rng) <= 1e-9


@EVERY
@DIM
def test_value_is_a_float_and_rows_cover_all_particles(name, k, dim, rng):
    bound = make(name, k, dim)
    assert bound.rows.shape[1] == made_matter(dim).n_particles
    value = bound.value(a_track(bound.rows.shape[0], dim, rng))
    assert isinstance(value, float)


def test_a_wrong_adjoint_fails(rng):
    bound = make("reach", 0, 2)
    track = a_track(1, 2, rng)
    right = bound.value_vjp
    wrong = lambda track, bar: TrackBar(x=1.001 * right(track, bar).x)  # noqa: E731
    assert adjoint_error(bound.value, wrong, track, rng) > 1e-4


def test_contact_examples_cover_both_sides_of_the_kink(rng):
    """The three examples of contact_free: some particles too deep, all, none."""
    for k, sides in enumerate([{True, False}, {True}, {False}]):
        bound = make("contact_free", k, 2)
        track = a_track(bound.rows.shape[0], 2, rng)
        assert set(np.unique(track.x[1:, :, bound.axis] < bound.clear)) == sides


@DIM
def test_loss_is_the_weighted_sum(dim, rng):
    matter = made_matter(dim)
    specs = {
        f"{name}{k}": plugins("objective")[name].model_validate(examples(dim)[name][k] | {"weight": 0.5 + k})
        for name, k in CASES
    }
    objective = Objective(specs, matter)
    track = a_track(objective.rows.shape[0], dim, rng)
    assert adjoint_error(objective.loss, objective.loss_vjp, track, rng) <= 1e-9
    values, row, loss = objective.values(track), 0, 0.0
    for name, spec in specs.items():
        bound = spec.bind(matter)
        rows = slice(row, row + bound.rows.shape[0])
        row = rows.stop
        alone = bound.value(replace(track, **{f: getattr(track, f)[:, rows] for f in ("x", "v", "C", "F")}))
        assert values[name] == alone
        assert (objective.rows[rows] != bound.rows).nnz == 0
        loss += spec.sense * spec.weight * alone
    assert objective.loss(track) == pytest.approx(loss)
    assert row == objective.rows.shape[0]


# --- kinks ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("over", "which"), [("minimum", 1), ("maximum", 0)])
def test_gradient_goes_to_the_first_of_equal_extremes(over, which):
    h = np.array([5.0, 2.0, 3.0, 2.0, 5.0])
    expected = np.zeros(5)
    expected[which] = 3.0
    np.testing.assert_array_equal(reduced_vjp(h, over, 0.1, 3.0), expected)


@pytest.mark.parametrize("zeros", [[], [2], [0, 4], [1, 2, 3]])
def test_gradient_of_a_product_with_zeros(zeros, rng):
    h, d = rng.normal(size=(2, 5))
    h[zeros] = 0.0
    expected = slope(lambda: reduced(moved(h, d), "product", 0.1), 1.0)
    # where two factors vanish, the complex step leaves its square instead of exactly zero
    assert np.dot(reduced_vjp(h, "product", 0.1, 1.0), d) == pytest.approx(expected, rel=1e-12, abs=STEP)


def test_gradient_of_a_distance_of_zero_is_zero():
    gap = np.array([[0.0, 0.0], [3.0, -4.0]])
    np.testing.assert_array_equal(lengths(gap, squared=False), [0.0, 5.0])
    np.testing.assert_allclose(lengths_vjp(gap, squared=False, h_bar=np.ones(2)), [[0.0, 0.0], [0.6, -0.8]])


def test_gradient_at_the_edge_of_contact_is_zero():
    bound = make("contact_free", 0, 2)
    k = bound.rows.shape[0]
    edge = np.full((N_CONTROLS + 1, k, 2), bound.clear)
    zeros = np.zeros((N_CONTROLS + 1, k, 2, 2))
    track = Track(edge, edge, zeros, zeros, np.zeros((N_CONTROLS, N_ACTUATORS)), {}, CONTROL_STEP)
    assert bound.value(track) == 0.0
    assert not bound.value_vjp(track, 1.0).x.any()

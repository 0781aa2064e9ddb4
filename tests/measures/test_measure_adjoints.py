"""Every measured quantity: its adjoint checked by differences of high order, on both sides of each kink."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_matter import CELL, N_ACTUATORS, averaged_matter, box_around_left, made_matter, mismatch
from made_tracks import a_track, products_of, random_directions

from cqrun.measures.chamber import WallPressure, WallVolume
from cqrun.measures.measure import BoundMeasure
from cqrun.measures.work import TotalWork
from cqrun.observers.matter import Matter, Wall
from cqrun.observers.track import Track
from cqrun.plugin.registry import plugins

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
WEIGHTS = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
"""A central difference of order 8 (Fornberg, Math. Comp. 51, 1988)."""

STEP = 1e-3
"""Its error is near 1e-12 for these tracks, whose lengths are 0.1 and more, and rounding adds as much."""


WORKING = (
    "muscle", "chamber", "old_chamber", "magnet", "cable", "weight", "tendon", "rubbed", "air", "gas", "oil", "both",
)  # fmt: skip
"""Actuators of `made_parts`."""


def examples(dim: int) -> dict[str, list[dict[str, Any]]]:
    """Return fields for each plug-in to test."""
    point, place = [0.31, 0.28, 0.23][:dim], {"body": "arm", "region": box_around_left(dim)}
    return {
        "position": [{"body": "arm"}, {"body": "arm", "point": point}, place],
        "displacement": [{"body": "arm", "group": "tip"}, {"body": "ball"}],
        "velocity": [{"body": "arm", "group": "left"}, {"body": "arm", "point": point}],
        "distance": [
            {"body": "arm", "group": "tip", "to_group": "left"}, {"body": "arm", "to": "ball"},
            {"body": "arm", "point": point, "position": [0.4, 0.5, 0.6][:dim]},
            {"body": "ball", "to": "arm", "to_point": point},
        ],
        "rotation": [{"body": "arm"}, place],
        "bend": [{"body": "arm", "group": "left", "to_group": "tip"}],
        "strain": [{"body": "arm"}, place],
        "stretch": [{"body": "arm"}, {"body": "arm", "group": "tip", "axis": [1.0, 2.0, -1.0][:dim]}],
        "kinetic_energy": [{"body": "arm", "group": "tip"}, {"body": "ball"}],
        "stress": [{"body": "arm", "group": "tip"}, {"body": "ball"}],
        "elastic_energy": [place, {"body": "ball"}],
        "dissipated_energy": [place, {"body": "arm"}, {"body": "ball"}],
        "cable_length": [{"cable": "cable"}, {"spring": "spring"}, {"cable": "tendon"}],
        "cable_tension": [
            {"cable": "cable"}, {"cable": "weight"}, {"spring": "spring"}, {"cable": "tendon"},
            {"cable": "tendon", "at": 1.0}, {"cable": "rubbed", "at": 0.6},
        ],
        "chamber_volume": [{"chamber": "air"}],
        "chamber_pressure": [{"chamber": name} for name in ("air", "gas", "oil")],
        "work": [{"actuator": name} for name in WORKING],
        "reaction": [{"boundary": "clamp"}, {"boundary": "floor", "of": "moment", "on": "boundary"}],
        "rigid_motion": [
            *({"rigid": "stone", "of": what} for what in ("displacement", "rotation", "velocity", "spin")),
            {"rigid": "stone", "of": "velocity", "relative_to": "jaw"},
        ],
    }  # fmt: skip


CASES = [(name, k) for name, tried in examples(2).items() for k in range(len(tried))]
EVERY = pytest.mark.parametrize(("name", "k"), CASES, ids=[f"{name}{k}" for name, k in CASES])


def make(name: str, k: int, dim: int, matter: Matter | None = None) -> BoundMeasure:
    spec = plugins("measure")[name].model_validate(examples(dim)[name][k])
    return spec.bind(matter or made_matter(dim))


def moved(value: Any, direction: Any, step: float) -> Any:
    """Return an array, or a mapping of arrays, moved along a direction."""
    if isinstance(value, dict):
        return {name: moved(value[name], direction[name], step) for name in value}
    if isinstance(value, list):
        return [moved(each, along, step) for each, along in zip(value, direction, strict=True)]
    return value + step * direction


def adjoint_error(bound: BoundMeasure, track: Track, rng: np.random.Generator) -> float:
    """Return the relative error of bar . (J d) = (J^T bar) . d."""
    directions = random_directions(track, rng)
    bar = rng.normal(size=bound.values(track).shape)

    def at(step: float) -> float:
        tilted = replace(track, **{name: moved(getattr(track, name), d, step) for name, d in directions.items()})
        return float(np.nansum(bar * bound.values(tilted)))

    expected = sum(weight * (at(STEP * k) - at(-STEP * k)) for k, weight in WEIGHTS) / STEP
    found = bound.values_vjp(track, bar)
    parts = products_of(found, directions)
    return mismatch(sum(float(p.sum()) for p in parts), expected, sum(float(np.abs(p).sum()) for p in parts))


def smooth_track(bound: BoundMeasure, dim: int, rng: np.random.Generator) -> Track:
    """Return a track without near kinks: places apart, parts that turned by less than half a turn, taut cables."""
    n_rows = bound.rows.shape[0]
    track = a_track(n_rows, dim, rng)
    x = np.arange(n_rows)[:, None] + 0.5 * track.x
    if bound.unit == "rad" and n_rows:
        c, s = np.cos(1.0), np.sin(1.0)
        turn = np.eye(dim)
        turn[:2, :2] = [[c, s], [-s, c]]
        x = 0.05 * track.x + np.concatenate([np.eye(dim), turn])[-n_rows:]
    if in_a_wall(bound):
        x = np.concatenate([np.zeros((1, dim)), np.eye(dim)]) + 0.1 * track.x
    activation = 0.2 + 0.1 * rng.uniform(size=track.activation.shape)
    F = np.diag([1.3, 0.9, 1.1][:dim]) + 0.05 * track.F
    return replace(track, x=x, F=F, activation=activation, rest_length=0.2 * track.rest_length)


def in_a_wall(bound: BoundMeasure) -> bool:
    """Return whether a quantity is one of a chamber, whose volume must be positive."""
    of = bound.works[0] if isinstance(bound, TotalWork) else bound
    return isinstance(of, WallVolume | WallPressure) or isinstance(getattr(of, "of", None), Wall)


@EVERY
@DIM
def test_adjoint_is_that_of_the_values(name, k, dim):
    rng, bound = np.random.default_rng([7, dim, k]), make(name, k, dim)
    for _ in range(3):
        assert adjoint_error(bound, smooth_track(bound, dim, rng), rng) < 1e-9


AVERAGED = [(name, k) for name, k in CASES if name in ("stress", "elastic_energy", "dissipated_energy")]


@pytest.mark.parametrize(("name", "k"), AVERAGED, ids=[f"{name}{k}" for name, k in AVERAGED])
@DIM
def test_adjoint_is_that_of_the_values_where_volumes_are_averaged(name, k, dim):
    """Also with respect to positions at rest, which are far from the kinks of hats, half a cell from the nodes."""
    rng, matter = np.random.default_rng([8, dim, k]), averaged_matter(dim)
    bound = make(name, k, dim, matter)
    track = replace(smooth_track(bound, dim, rng), rest=matter.x)
    cells = matter.x / CELL - 0.5
    assert np.abs(cells - np.round(cells)).min() * CELL > 100 * STEP
    for _ in range(3):
        assert adjoint_error(bound, track, rng) < 1e-9


def test_every_measured_quantity_is_tested():
    assert set(examples(2)) == set(plugins("measure"))


@EVERY
@DIM
def test_number_of_components_and_their_range_fit_the_values(name, k, dim):
    rng, bound = np.random.default_rng(3), make(name, k, dim)
    values = bound.values(smooth_track(bound, dim, rng))
    assert values.shape[1] == len(bound.components) == len(bound.low) == len(bound.high)
    assert len(set(bound.components)) == len(bound.components)
    assert np.all(bound.low < bound.high)
    assert bound.unit
    assert bound.meaning


@DIM
@pytest.mark.parametrize("activation", [-0.3, 0.3])
@pytest.mark.parametrize("taut", [True, False])
def test_tension_of_a_cable_has_its_adjoint_on_each_side_of_its_kinks(dim, activation, taut):
    rng, bound = np.random.default_rng(5), make("cable_tension", 0, dim)
    track = smooth_track(bound, dim, rng)
    rest = np.full(N_ACTUATORS + 1, 0.2 if taut or activation < 0 else 40.0)
    track = replace(track, activation=np.full(track.activation.shape, activation), rest_length=rest)
    values = bound.values(track)
    assert np.all(values > 0) if taut or activation < 0 else not np.any(values)
    if taut or activation < 0:
        assert adjoint_error(bound, track, rng) < 1e-9
    else:
        found = bound.values_vjp(track, np.ones(values.shape))
        assert not any(np.any(getattr(found, part)) for part in ("x", "activation", "strength", "rest_length"))


@DIM
def test_where_a_gradient_does_not_exist_it_is_zero(dim):
    rng = np.random.default_rng(1)
    gap = make("distance", 0, dim)
    track = smooth_track(gap, dim, rng)
    together = replace(track, x=np.repeat(track.x[:, :1], 2, axis=1))
    assert not np.any(gap.values_vjp(together, np.ones((len(track.x), 1))).x)
    line = make("cable_length", 0, dim)
    once = replace(track, x=np.repeat(track.x[:, :1], 4, axis=1))
    assert not np.any(line.values_vjp(once, np.ones((len(track.x), 1))).x)
    if dim == 3:
        bend, at_rest = make("bend", 0, dim), np.tile(np.eye(3), (7, 2, 1))
        still = replace(track, x=at_rest)
        assert not np.any(bend.values(still))
        assert not np.any(bend.values_vjp(still, np.ones((7, 1))).x)

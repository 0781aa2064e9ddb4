"""Values of each observer in known cases, ranges, and errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import pytest
from made_matter import CONTROL_STEP, box_around_left, made_matter
from pydantic import TypeAdapter, ValidationError

from cqrun.errors import UsageError
from cqrun.observers.matter import Matter
from cqrun.observers.observer import Moment, Observation, Observer
from cqrun.plugin.choice import Choice, Chosen
from cqrun.state import State

CHOSEN = TypeAdapter(Annotated[Chosen[Observer], Choice("observer")])


def observer(name: str, **fields: Any) -> Observer:
    spec: Observer = CHOSEN.validate_python({name: fields}).value
    return spec


def moment_of(rows: Any, state: State, *, time: float = 0.0, control: int = 0, memory: Any = (), goals: Any = None):
    """Return the moment for an observer with these rows."""
    flat = lambda a: (rows @ a.reshape(len(a), -1)).reshape(rows.shape[0], *a.shape[1:])  # noqa: E731
    sums = [flat(a) for a in (state.x, state.v, state.C, state.F)]
    return Moment(*sums, time, control, goals or {}, np.array(memory, float), lambda: state)


def look(spec: Observer, matter: Matter, state: State, **moment: Any) -> np.ndarray:
    """Return an observer's values, in their own units."""
    bound = spec.bind(matter)
    return bound.observe(moment_of(bound.rows, state, **moment))[0]


@pytest.fixture
def matter() -> Matter:
    return made_matter(2)


@pytest.fixture
def state(matter, rng) -> State:
    return replace(State.at_rest(matter.x + 0.01), v=rng.normal(size=matter.x.shape))


def test_centroids_are_plain_means_group_by_group(matter, state):
    heavy = replace(matter, mass=np.arange(1.0, 1.0 + len(matter.x)))  # masses do not matter
    groups = matter.groups["arm"]
    expected = [[state.x[g].mean(axis=0), state.v[g].mean(axis=0)] for g in groups.values()]
    np.testing.assert_allclose(look(observer("centroids", body="arm"), heavy, state), np.ravel(expected))
    picked = observer("centroids", body="arm", groups=["tip"], of=["velocity", "position"])
    np.testing.assert_allclose(look(picked, heavy, state), np.ravel(expected[1][::-1]))


def test_a_body_without_groups_is_one_centroid(matter, state):
    ball = matter.bodies["ball"]
    np.testing.assert_allclose(
        look(observer("centroids", body="ball", of=["position"]), matter, state), state.x[ball].mean(axis=0)
    )


def test_acceleration_is_the_change_over_the_last_control_step(matter, state):
    bound = observer("centroids", body="ball", of=["acceleration"]).bind(matter)
    gravity, memory, values = np.array([0.5, -2.0]), np.zeros(bound.n_memory), []
    for control in range(3):
        falling = replace(state, v=np.ones_like(state.v) + gravity * control * CONTROL_STEP)
        z, memory = bound.observe(moment_of(bound.rows, falling, control=control, memory=memory))
        values.append(z)
    np.testing.assert_array_equal(values[0], 0.0)
    np.testing.assert_allclose(values[1:], [gravity, gravity])


def test_ranges_are_scaled_to_minus_one_to_one(matter, state):
    places = {"auto": {}, "raw": {"range": None}, "given": {"range": {"position": [0.0, 0.5], "velocity": None}}}
    specs = {name: observer("centroids", body="ball", **fields) for name, fields in places.items()}
    observation = Observation.of(specs, matter)
    z, _ = observation.observe(moment_of(observation.rows, state))
    x, v = (a[matter.bodies["ball"]].mean(axis=0) for a in (state.x, state.v))
    np.testing.assert_allclose(z[observation.parts["auto"]], [*(2 * x / matter.size - 1), *(v / matter.size)])
    np.testing.assert_array_equal(z[observation.parts["raw"]], [*x, *v])
    np.testing.assert_allclose(z[observation.parts["given"]], [*(4 * x - 1), *v])


@pytest.mark.parametrize("name", ["goal", "strain", "centroids"])
def test_a_null_range_survives_a_resolved_scene(name):
    """A resolved scene does not contain null values; it must still mean the same when it is read again."""
    fields = {"goal": "target"} if name == "goal" else {"body": "arm"}
    chosen = CHOSEN.validate_python({name: {**fields, "range": None}})
    again = CHOSEN.validate_python(CHOSEN.dump_python(chosen, exclude_none=True))
    assert again == chosen
    assert again != CHOSEN.validate_python({name: fields})


@pytest.mark.parametrize(
    "bad", [[1.0, 1.0], [0.0], "automatic", [[0.0, 1.0], [2.0]], [0.0, float("inf")], [True, 2], []]
)
def test_invalid_range_is_an_error(bad):
    with pytest.raises(ValidationError, match=r"must be \[low, high\] with low < high"):
        observer("strain", body="arm", range=bad)


def test_number_of_ranges_must_be_that_of_the_entries(matter):
    with pytest.raises(UsageError, match=r"2 pairs \[low, high\] for 3 entries"):
        observer("strain", body="arm", range=[[0, 1], [0, 1]]).bind(matter)


def test_two_separate_heaps_are_two_clusters(matter, state):
    """The body consists of two heaps far apart."""
    apart = matter.x.copy()
    apart[matter.groups["arm"]["tip"]] -= [5.0, 0.0]  # the tip lies left of the rest now
    far = replace(matter, x=apart)
    tip = matter.groups["arm"]["tip"]
    rest = np.setdiff1d(np.arange(12), tip)
    z = look(observer("clusters", body="arm", count=2, of=["position"]), far, state)
    np.testing.assert_allclose(z, [*state.x[tip].mean(axis=0), *state.x[rest].mean(axis=0)])


def test_more_clusters_than_particles_is_an_error(matter):
    with pytest.raises(UsageError, match="5 clusters of 4 particles"):
        observer("clusters", body="ball", count=5).bind(matter)


@pytest.mark.parametrize("dim", [2, 3])
def test_strain_does_not_depend_on_rotation(dim, rng):
    matter = made_matter(dim)
    Q, _ = np.linalg.qr(rng.normal(size=(dim, dim)))
    F = np.eye(dim) + 0.1 * rng.normal(size=(dim, dim))
    at_rest, bent = State.at_rest(matter.x), State.at_rest(matter.x)
    at_rest.F[:], bent.F[:] = Q, Q @ F
    axis = rng.normal(size=dim)
    for spec in (observer("strain", body="arm"), observer("strain", body="arm", axis=list(axis))):
        np.testing.assert_allclose(look(spec, matter, at_rest), 0.0, atol=1e-14)
    E = 0.5 * (F.T @ F - np.eye(dim))
    off = [E[0, 1]] if dim == 2 else [E[0, 1], E[0, 2], E[1, 2]]
    np.testing.assert_allclose(look(observer("strain", body="arm"), matter, bent), [*np.diag(E), *off])
    stretch = np.linalg.norm(F @ axis) / np.linalg.norm(axis) - 1
    np.testing.assert_allclose(look(observer("strain", body="arm", axis=list(axis)), matter, bent), stretch)


def test_strain_is_measured_in_its_region_only(matter, state):
    left = np.flatnonzero(matter.x[:12, 0] < 0.35)
    state.F[left] = np.diag([1.5, 1.0])
    spec = observer("strain", body="arm", region=box_around_left(2), axis=[3, 0])
    np.testing.assert_allclose(look(spec, matter, state), 0.5)


def test_gradient_of_the_stretch_is_zero_where_F_vanishes(matter, state):
    bound = observer("strain", body="arm", axis=[1, 0]).bind(matter)
    moment = replace(moment_of(bound.rows, state), F=np.zeros((1, 2, 2)))
    assert bound.observe(moment)[0] == [-1.0]
    assert not bound.observe_vjp(moment, np.ones(1), np.zeros(0)).F.any()


def test_clock(matter, state):
    phase = look(observer("clock", period=0.4, harmonics=2), matter, state, time=0.1)
    np.testing.assert_allclose(phase, [1, 0, 0, -1], atol=1e-15)
    observation = Observation.of({"clock": observer("clock")}, matter)
    ends = [observation.observe(moment_of(observation.rows, state, time=t))[0][0] for t in (0.0, matter.duration)]
    assert ends == pytest.approx([-1, 1])
    with pytest.raises(ValidationError, match="has no meaning without a period"):
        observer("clock", harmonics=2)


def test_goal_is_relative_to_the_body(matter, state):
    goals, tip = {"target": np.array([0.6, 0.7])}, matter.groups["arm"]["tip"]
    z = look(observer("goal", goal="target", body="arm", group="tip"), matter, state, goals=goals)
    np.testing.assert_allclose(z, goals["target"] - state.x[tip].mean(axis=0))
    np.testing.assert_array_equal(look(observer("goal", goal="target"), matter, state, goals=goals), goals["target"])


@pytest.mark.parametrize(
    ("name", "fields", "words"),
    [
        ("centroids", {"body": "leg"}, "no body called 'leg'; there are: arm, ball"),
        ("centroids", {"body": "arm", "groups": ["tips"]}, r"of the body 'arm' called 'tips' \(did you mean 'tip'"),
        ("centroids", {"body": "ball", "groups": ["tip"]}, "no group of the body 'ball' called 'tip'; there are: none"),
        ("strain", {"body": "ball", "region": box_around_left(2)}, "this region of the body 'ball' holds no particle"),
        ("goal", {"goal": "targt"}, r"no goal called 'targt' \(did you mean 'target'"),
        ("goal", {"goal": "pace"}, "the goal 'pace' has 1 entries; a position here has 2"),
        ("goal", {"goal": "target", "group": "tip"}, "the group 'tip' needs its body"),
        ("pca", {"body": "arm", "components": 2}, "the pca has no components: give a `file` of them"),
    ],
)  # fmt: skip
def test_names_that_do_not_fit_the_scene_are_errors(matter, name, fields, words):
    with pytest.raises(UsageError, match=words):
        observer(name, **fields).bind(matter)


def test_empty_group_is_an_error(matter):
    matter.groups["arm"]["tip"] = np.zeros(0, int)
    with pytest.raises(UsageError, match="tip of the body 'arm' holds no particle"):
        observer("centroids", body="arm").bind(matter)


def test_axis_must_be_a_direction_of_the_world():
    assert observer("strain", body="arm", axis=[0.0, 0.0]).dim_problems(2) == [
        (("axis",), "must not be zero; give a direction, or leave it out for all components")
    ]
    assert observer("strain", body="arm", axis=[1.0, 0.0]).dim_problems(3)

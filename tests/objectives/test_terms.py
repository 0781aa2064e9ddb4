"""Values of each objective term in known cases, signs, and errors."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import pytest
from made_matter import CONTROL_STEP, N_ACTUATORS, N_CONTROLS, made_matter
from pydantic import TypeAdapter, ValidationError

from cqrun.errors import UsageError
from cqrun.objectives.term import Objective, ObjectiveTerm, reduced
from cqrun.observers.track import Track
from cqrun.plugin.choice import Choice, Chosen

CHOSEN = TypeAdapter(Annotated[Chosen[ObjectiveTerm], Choice("objective")])
MATTER = made_matter(2)
TIMES = CONTROL_STEP * np.arange(N_CONTROLS + 1)
STEPS = (N_CONTROLS + 1, len(MATTER.x))


def term(name: str, **fields: Any) -> ObjectiveTerm:
    spec: ObjectiveTerm = CHOSEN.validate_python({name: fields}).value
    return spec


def motion(rows: Any, *, x: Any = 0.0, v: Any = 0.0, activation: Any = 0.0, goals: Any = None) -> Track:
    """Return a track of all particles, moved by x(t, p) from rest, with velocities v(t, p)."""
    shape = (*STEPS, 2)
    places, speeds = np.broadcast_to(MATTER.x + x, shape), np.broadcast_to(v, shape).astype(float)
    sums = [np.stack([rows @ frame for frame in field]) for field in (places, speeds)]
    none = np.zeros((N_CONTROLS + 1, rows.shape[0], 2, 2))
    return Track(*sums, none, none, np.broadcast_to(activation, (N_CONTROLS, N_ACTUATORS)).astype(float), goals or {},
                 CONTROL_STEP)  # fmt: skip


def value(spec: ObjectiveTerm, **moved: Any) -> float:
    bound = spec.bind(MATTER)
    return bound.value(motion(bound.rows, **moved))


def walk(speed: float) -> np.ndarray:
    """Return displacements (T+1, 1, 2) of a body that moves along x."""
    return speed * TIMES[:, None, None] * np.array([1.0, 0.0])


def test_distance_is_that_of_the_centroid():
    spec = term("distance", body="arm")
    assert value(spec, x=walk(0.4)) == pytest.approx(0.4 * TIMES[-1])
    assert value(term("distance", body="arm", over="mean"), x=walk(0.4)) == pytest.approx(0.4 * TIMES[1:].mean())
    assert value(term("distance", body="arm", axis="y"), x=walk(0.4)) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(("name", "fields"), [("distance", {"body": "arm"}), ("height", {"body": "arm"})])
def test_terms_that_should_be_large_are_counted_negative(name, fields):
    objective = Objective({"far": term(name, **fields, axis="x", over="final", weight=3.0)}, MATTER)
    near, far = (motion(objective.rows, x=walk(speed)) for speed in (0.1, 0.2))
    assert objective.loss(far) == pytest.approx(-3.0 * objective.values(far)["far"])
    assert objective.loss(far) < objective.loss(near)


def test_height_is_a_coordinate_of_the_centroid():
    tip = MATTER.x[MATTER.groups["arm"]["tip"]].mean(axis=0)
    assert value(term("height", body="arm", group="tip"), x=[0.0, 0.25]) == pytest.approx(tip[1] + 0.25)


def test_reach_of_a_goal_a_position_and_a_body():
    goals = {"target": np.array([0.6, 0.7])}
    arm, ball, tip = (MATTER.x[i].mean(axis=0) for i in (MATTER.members("arm"), MATTER.members("ball"),
                                                        MATTER.members("arm", "tip")))  # fmt: skip
    for fields, gap in [
        ({"goal": "target"}, arm - goals["target"]),
        ({"position": [0.1, 0.2]}, arm - [0.1, 0.2]),
        ({"target": "ball", "group": "tip"}, tip - ball),
    ]:
        spec = term("reach", body="arm", **fields)
        assert value(spec, goals=goals) == pytest.approx(gap @ gap)
        plain = term("reach", body="arm", squared=False, **fields)
        assert value(plain, goals=goals) == pytest.approx(np.linalg.norm(gap))


def test_rest_of_the_centroid_and_of_all_particles():
    """A body that spins about its centroid: the centroid rests, its particles do not."""
    members = MATTER.members("arm")
    r = MATTER.x - MATTER.x[members].mean(axis=0)
    spin = 2.0 * np.stack([-r[:, 1], r[:, 0]], axis=1)
    assert value(term("rest", body="arm"), v=spin) == pytest.approx(0.0, abs=1e-15)
    assert value(term("rest", body="arm", particles=True), v=spin) == pytest.approx(4 * np.mean(r[members] ** 2) * 2)
    assert value(term("rest", body="arm"), v=[3.0, 4.0]) == pytest.approx(25.0)


def test_effort_is_the_integral_of_squared_activations():
    u = np.zeros((N_CONTROLS, N_ACTUATORS))
    u[1], u[2] = [1.0, -2.0, 0.0], [0.0, 0.0, 3.0]
    assert value(term("effort"), activation=u) == pytest.approx(CONTROL_STEP * (5 + 9))
    assert value(term("effort", over="maximum"), activation=u) == 9.0


def test_effort_counts_from_zero_or_from_neutral():
    """The last two actuators do nothing at 1 and at 0.5."""
    idle = np.tile([0.0, 1.0, 0.5], (N_CONTROLS, 1))
    for fields in ({}, {"counted_from": "zero"}):
        assert value(term("effort", **fields), activation=idle) == pytest.approx(CONTROL_STEP * N_CONTROLS * 1.25)
    assert value(term("effort", counted_from="neutral"), activation=idle) == 0.0
    pulled = idle - [0.0, 1.0, 0.0]
    assert value(term("effort", counted_from="neutral"), activation=pulled) == pytest.approx(CONTROL_STEP * N_CONTROLS)


def test_track_of_a_path():
    start = MATTER.x[MATTER.members("arm")].mean(axis=0)
    path = [[0.0, *start], [1.0, start[0] + 0.4, start[1]]]
    assert value(term("track", body="arm", path=path), x=walk(0.4)) == pytest.approx(0.0, abs=1e-30)
    slower = value(term("track", body="arm", path=path), x=walk(0.3))
    assert slower == pytest.approx(np.mean((0.1 * TIMES[1:]) ** 2))
    beyond = term("track", body="arm", path=[[0.0, *start]], over="final")
    assert value(beyond, x=walk(0.3)) == pytest.approx((0.3 * TIMES[-1]) ** 2), "the path is constant after its end"


def test_key_frames_are_compared_at_their_times_only():
    start = MATTER.x[MATTER.members("arm")].mean(axis=0)
    when = 2.5 * CONTROL_STEP  # between control steps: the cubic Hermite of a straight walk is the walk
    keys = [[when, start[0], start[1] + 0.1], [TIMES[-1], *start]]
    spec = term("track", body="arm", keys=keys)
    expected = np.mean([(0.4 * when) ** 2 + 0.01, (0.4 * TIMES[-1]) ** 2])
    assert value(spec, x=walk(0.4), v=[0.4, 0.0]) == pytest.approx(expected)


def test_contact_free_counts_depth_below_height_and_margin():
    members = MATTER.members("arm")
    clear = term("contact_free", body="arm", height=0.0, margin=0.1)
    assert value(clear) == 0.0, "the arm is 0.2 above"
    depth = np.maximum(0.3 - MATTER.x[members, 1], 0.0)
    assert value(term("contact_free", body="arm", height=0.25, margin=0.05)) == pytest.approx(np.mean(depth**2))


def gripped(spec: ObjectiveTerm, stone: Any, jaw: Any = (0.0,) * 6) -> float:
    """Return the value of a term for rigid bodies with displacement, rotation, velocity and spin (6,) at every time."""
    bound = spec.bind(MATTER)
    rigid = {name: np.broadcast_to(rows, (N_CONTROLS + 1, 6)) for name, rows in (("stone", stone), ("jaw", jaw))}
    return bound.value(replace(motion(bound.rows, v=[0.5, 0.0]), rigid=rigid))


def test_a_rigid_body_that_moves_with_its_hand_is_held():
    stone, jaw = [0.1, 0.2, 0, 0.3, -0.4, 9], [0, 0, 1, 0.3, -0.4, 0]
    assert gripped(term("hold", rigid="stone"), stone) == pytest.approx(0.25)
    assert gripped(term("hold", rigid="stone", squared=False, over="maximum"), stone) == pytest.approx(0.5)
    assert gripped(term("hold", rigid="stone", by="jaw"), stone, jaw) == 0.0
    assert gripped(term("hold", rigid="stone", body="arm", over="final"), stone) == pytest.approx(0.2**2 + 0.4**2)
    half = term("hold", rigid="stone", begin=TIMES[2], end=TIMES[3])
    assert gripped(half, stone) == pytest.approx(0.25 * 2 / N_CONTROLS)


def test_a_rigid_body_that_is_too_low_is_not_lifted():
    assert gripped(term("lift", rigid="stone", height=0.3), [0.1, 0.2, 0, 0, 0, 0]) == pytest.approx(0.01)
    assert gripped(term("lift", rigid="stone", height=0.3, axis="x"), [0.1, 0.2, 0, 0, 0, 0]) == pytest.approx(0.04)
    assert gripped(term("lift", rigid="stone", height=0.1), [0.1, 0.2, 0, 0, 0, 0]) == 0.0


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("hold", {"by": "jaw", "body": "arm"}, "has `by` and `body`: give one of them"),
        ("hold", {"by": "stone"}, "'stone' cannot hold itself"),
        ("lift", {"height": 0.1, "begin": 99}, "counts from 99 s, in which no control step of the run ends"),
    ],
)
def test_what_cannot_be_held_is_refused(name, fields, message):
    with pytest.raises(UsageError, match=message):
        term(name, rigid="stone", **fields).bind(MATTER)


@pytest.mark.parametrize(
    ("over", "expected"), [("final", 4.0), ("mean", 2.0), ("sum", 0.6), ("minimum", -1.0), ("maximum", 4.0),
                           ("product", -12.0)],
)  # fmt: skip
def test_reductions(over, expected):
    assert reduced(np.array([3.0, -1.0, 4.0]), over, 0.1) == pytest.approx(expected)


def test_reductions_leave_out_the_start():
    """Every reduction is over the ends of control steps 1 .. T."""
    jump = np.zeros((N_CONTROLS + 1, 1, 2))
    jump[0] = 7.0
    at = MATTER.x[MATTER.members("ball")].mean(axis=0)
    for over in ("mean", "maximum", "sum"):
        spec = term("reach", body="ball", position=list(at), over=over)
        assert value(spec, x=jump) == pytest.approx(0.0, abs=1e-25)


@pytest.mark.parametrize(
    ("name", "fields", "words"),
    [
        ("reach", {"body": "arm"}, "needs exactly one of goal, position, target; has none"),
        ("reach", {"body": "arm", "goal": "target", "target": "ball"}, "exactly one of .*; has goal, target"),
        ("reach", {"body": "arm", "goal": "target", "target_group": "tip"}, "no meaning without a target"),
        ("track", {"body": "arm"}, "needs exactly one of path, keys, marker; has none"),
        ("track", {"body": "arm", "path": [[0, 0, 0]], "keys": [[0, 0, 0]]}, "marker; has path, keys"),
        ("track", {"body": "arm", "path": [[0, 0, 0], [0, 1, 1]]}, "increase from point to point"),
        ("track", {"body": "arm", "keys": [[-1, 0, 0]]}, "begin at 0 or later"),
        ("distance", {"body": "arm", "over": "final", "axis": "w"}, "must be 'x', 'y' or 'z'"),
        ("effort", {"over": "min"}, "must be 'final', 'mean', .*, is 'min'"),
    ],
)
def test_fields_that_do_not_fit_together_are_errors(name, fields, words):
    with pytest.raises(ValidationError, match=words):
        term(name, **fields)


@pytest.mark.parametrize(
    ("name", "fields", "words"),
    [
        ("distance", {"body": "leg"}, "no body called 'leg'"),
        ("height", {"body": "arm", "group": "head"}, "no group of the body 'arm' called 'head'; there are: left, tip"),
        ("reach", {"body": "arm", "goal": "aim"}, "no goal called 'aim'; there are: target, pace"),
        ("reach", {"body": "arm", "goal": "pace"}, "the goal 'pace' has 1 entries; a position here has 2"),
        ("reach", {"body": "arm", "target": "bal"}, r"no body called 'bal' \(did you mean 'ball'"),
        ("track", {"body": "arm", "keys": [[5.0, 0, 0]]}, "a key frame at 5 s is after the end of the run at 0.3 s"),
        ("track", {"body": "arm", "path": [[5.0, 0, 0]]}, "the path begins at 5 s, after the end of the run at 0.3 s"),
        ("contact_free", {"body": "arm", "height": 0, "region": {"ball": {"center": [9, 9], "radius": 1}}},
         "this region of the body 'arm' holds no particle"),
    ],
)  # fmt: skip
def test_names_that_do_not_fit_the_scene_are_errors(name, fields, words):
    with pytest.raises(UsageError, match=words):
        term(name, **fields).bind(MATTER)


def test_axis_and_points_must_fit_the_dimension_of_the_world():
    assert term("distance", body="arm", axis="z").dim_problems(2) == [(("axis",), "a 2D world has no axis z")]
    assert term("distance", body="arm", axis="z").dim_problems(3) == []
    (place, message), *_ = term("track", body="arm", path=[[0, 1, 2]]).dim_problems(3)
    assert place == ("path", 0)
    assert message == "must have 4 entries in this 3D world, time first, has 3"
    assert term("reach", body="arm", position=[0, 0]).dim_problems(3)


@pytest.mark.parametrize("power", [40, 256, 4096])
def test_stretch_is_near_the_largest_and_never_below_it(power):
    bound = term("stretch", body="arm", power=power).bind(MATTER)
    F = np.tile(np.eye(2), (*STEPS[:1], bound.rows.shape[0], 1, 1))
    track = Track(np.zeros(F.shape[:3]), np.zeros(F.shape[:3]), F, F, np.zeros((N_CONTROLS, 1)), {}, CONTROL_STEP)
    above = (2 * F.shape[1]) ** (1 / power)
    assert bound.value(track) == pytest.approx(above * N_CONTROLS ** (1 / power))
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    F[3, 5] = turn @ np.diag([1.7, 0.9]) @ turn.T
    assert 1.7 - 1e-12 <= bound.value(track) <= 1.7 * above * N_CONTROLS ** (1 / power)
    largest = term("stretch", body="arm", power=power, over="maximum").bind(MATTER)
    assert 1.7 - 1e-12 <= largest.value(track) <= min(1.7 * above, bound.value(track) + 1e-12)
    slope = bound.value_vjp(track, 1.0).F[3, 5]
    np.testing.assert_allclose(slope, turn @ np.diag([1.0, 0.0]) @ turn.T, atol=1e-6)
    F[4], F[5] = 1e100 * np.eye(2), 1e-100 * np.eye(2)
    assert bound.value(track) == pytest.approx(1e100 * above)
    assert np.isfinite(bound.value_vjp(track, 1.0).F).all()


def test_stretch_is_faster_than_singular_values(rng):
    """Value and gradient together, for more particles than are processed at a time."""
    bound = term("stretch", body="arm").bind(MATTER)
    F = np.eye(2) + 0.1 * rng.normal(size=(20, 4000, 2, 2))
    track = Track(np.zeros(F.shape[:3]), np.zeros(F.shape[:3]), F, F, np.zeros((19, 1)), {}, CONTROL_STEP)
    singular = np.linalg.norm(F[1:], 2, axis=(2, 3))
    value = bound.value(track)
    assert singular.max() <= value <= singular.max() * (2 * singular.size) ** (1 / 256)
    slope = bound.value_vjp(track, 1.0).F
    assert (slope * F).sum() == pytest.approx(value), "the largest stretch is homogeneous of degree 1 in F"
    assert not slope[0].any()

    def seconds(what):
        begin = time.thread_time()
        what()
        return time.thread_time() - begin

    elapsed = min(seconds(lambda: (bound.value(track), bound.value_vjp(track, 1.0))) for _ in range(3))
    assert elapsed < min(seconds(lambda: np.linalg.norm(F[1:], 2, axis=(2, 3))) for _ in range(3))


def test_unchanged_is_the_mean_squared_relative_change():
    bound = term("unchanged", body="arm", of="mass").bind(MATTER)
    design = MATTER.design.copy()
    nothing = np.zeros((N_CONTROLS + 1, 0, 2))
    track = Track(nothing, nothing, nothing, nothing, np.zeros((N_CONTROLS, 1)), {}, CONTROL_STEP, design)
    assert bound.value(track) == 0.0
    design[0] *= 1.1
    assert bound.value(track) == pytest.approx(0.01)
    design[1] *= 3.0  # the volume is not part of it
    assert bound.value(track) == pytest.approx(0.01)

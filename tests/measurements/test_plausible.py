"""Recordings of what no body does: gaps written as zeros, leaps, exchanged labels, held positions, other units."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from cqrun.errors import DataError
from cqrun.measurements.plausible import plausible
from cqrun.measurements.recording import Recording

REACH, ALWAYS = 0.12, (0.0, 10.0)
REST = np.array([[0.31, 0.22, 0.15], [0.29, 0.26, 0.16], [0.21, 0.22, 0.15], [0.22, 0.26, 0.17]])


@pytest.fixture(params=[2, 3])
def swing(request, rng):
    """Return a body at 100 Hz: at rest for 0.5 s, then swinging at 4 Hz with an amplitude of 3 cm, and with noise."""
    time = 0.01 * np.arange(200)
    motion = 0.03 * (1 - np.cos(25 * np.maximum(time - 0.5, 0))) * np.exp(-2 * np.maximum(time - 0.5, 0))
    x = REST + motion[:, None, None] * np.array([[0.2, 0.1, -1]] * 2 + [[0.05, 0, -0.2]] * 2)
    x = x + 2e-5 * rng.normal(size=x.shape)
    return Recording(time, ("a", "b", "c", "d"), x[..., {2: [0, 2], 3: [0, 1, 2]}[request.param]], "swing.c3d")


def changed(recording, marker, frames, to):
    """Return a recording in which a marker is somewhere else in some frames."""
    positions = recording.positions.copy()
    positions[frames, marker] = to
    return replace(recording, positions=positions)


def unseen(recording, found):
    """Return marker and frames that were taken out; everything else must be the same."""
    out = ~found.seen() & recording.seen()
    np.testing.assert_array_equal(found.positions[~out], recording.positions[~out])
    return {recording.names[m]: np.flatnonzero(out[:, m]).tolist() for m in np.flatnonzero(out.any(axis=0))}


def judged(recording, reach=REACH, span=ALWAYS):
    found, doubts = plausible(recording, reach, span)
    return unseen(recording, found), doubts


# ---------------------------------------------------------------- nothing is wrong


@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_a_real_motion_is_left_as_it_is(swing, factor):
    """Also in millimetres that are taken for metres, of which the alignment tells."""
    assert judged(replace(swing, positions=factor * swing.positions)) == ({}, ())


def test_every_other_gap_is_left_as_it_is(swing, rng):
    positions = swing.positions.copy()
    positions[rng.random(positions.shape[:2]) < 0.4] = np.nan
    assert judged(replace(swing, positions=positions)) == ({}, ())


def test_a_position_that_is_rounded_may_stay_the_same(swing):
    assert judged(replace(swing, positions=np.round(swing.positions, 3))) == ({}, ())


def test_a_model_without_noise_may_stand_still_and_begin_at_zero(swing):
    """As data of another simulation: at rest to the bit, one marker clamped, one that starts at the origin."""
    time = swing.time
    fall = np.maximum(time - 0.5, 0) ** 2
    rest, along = np.array([[0, 0], [0.1, 0], [0.05, 0.1]]), np.array([[0, -1], [0.3, -1], [0, 0]])
    x = rest + fall[:, None, None] * along
    assert judged(Recording(time, ("tip", "middle", "root"), x, "fem.csv")) == ({}, ())


def test_a_thrown_body_may_move_by_more_than_its_size_in_a_frame():
    time = np.arange(60) / 30
    x = np.maximum(time - 1, 0)[:, None, None] * [[[5.0, 0.3]]] + [[[0.4, 0.1], [0.45, 0.1]]]
    assert judged(Recording(time, ("a", "b"), x, "ball.csv"), reach=0.1) == ({}, ())


def test_a_load_in_steps_is_no_error():
    held = np.repeat([0.0, 0.4, 0.9, 1.7, 2.2, 3.1], 10)[:, None, None]
    x = [[[0.3, 0.1], [0.2, 0.1]]] + 0.01 * held * [[[0.0, -1.0], [0.0, -0.5]]]
    assert judged(Recording(0.1 * np.arange(60), ("a", "b"), x, "static.csv"))[0] == {}


def test_what_is_outside_the_frames_that_count_does_not_matter(swing):
    """Somebody takes the body away when the measurement is over."""
    away = changed(swing, slice(None), slice(180, None), 0.0)
    assert judged(away, span=(0.0, 1.7)) == ({}, ())
    found, doubts = judged(away)
    assert set(found) == {"a", "b", "c", "d"}
    assert "in frames 180 to 199 (1.8 to 1.99 s): taken as not seen" in doubts[0]


# ---------------------------------------------------------------- taken as not seen


def test_zeros_are_gaps(swing):
    """In the still frames, while it moves, and to the end; by marker and frames."""
    lost = changed(changed(swing, 0, [*range(10, 20), 80, *range(190, 200)], 0.0), 3, [5], 0.0)
    found, doubts = judged(lost)
    assert found == {"a": [*range(10, 20), 80, *range(190, 200)], "d": [5]}
    assert doubts == (
        "marker 'a' is at exactly 0 in frames 10 to 19, 80, 190 to 199 (0.1 to 1.99 s): taken as not seen",
        "marker 'd' is at exactly 0 in frame 5 (0.05 s): taken as not seen",
    )


def test_zeros_are_gaps_for_most_of_the_time_and_near_the_origin(swing):
    near = replace(swing, positions=swing.positions - swing.positions[0, 0] + 0.02)
    frames = [k for k in range(200) if k % 10 > 3]
    assert judged(changed(near, 0, frames, 0.0))[0] == {"a": frames}


@pytest.mark.parametrize("frames", [[90], list(range(90, 97)), list(range(20, 50))])
def test_a_leap_farther_than_the_body_is_across(swing, frames):
    found, doubts = judged(changed(swing, 1, frames, swing.positions[frames, 1] + 0.2))
    assert found == {"b": frames}
    assert re.match(r"marker 'b' leaps by 0\.\d+ m, and the body is 0\.1\d* m across, in frames? ", doubts[0])


def test_a_leap_to_two_places(swing):
    wrong = changed(changed(swing, 1, [90, 91], 0.9), 1, [92], -0.7)
    assert judged(wrong)[0] == {"b": [90, 91, 92]}


def test_labels_that_are_exchanged_for_some_frames(swing):
    frames = list(range(110, 125))
    positions = swing.positions.copy()
    positions[frames, 0], positions[frames, 2] = swing.positions[frames, 2], swing.positions[frames, 0]
    found, doubts = judged(replace(swing, positions=positions))
    assert found == {"a": frames, "c": frames}
    when = "in frames 110 to 124 (1.1 to 1.24 s)"
    assert doubts[0] == f"marker 'a' is where 'c' was just before {when}: taken as not seen"


def test_one_marker_with_the_label_of_two(swing):
    frames = list(range(30, 35))
    found, doubts = judged(changed(swing, 3, frames, swing.positions[frames, 2]))
    assert found == {"d": frames}
    assert doubts == ("marker 'd' is where 'c' was just before in frames 30 to 34 (0.3 to 0.34 s): taken as not seen",)


def test_a_position_that_is_held_while_the_body_moves(swing):
    frames = list(range(57, 65))
    found, doubts = judged(changed(swing, 0, frames, swing.positions[56, 0]))
    assert found == {"a": frames}
    assert doubts == (
        "marker 'a' keeps exactly one place, while others move, in frames 57 to 64 (0.57 to 0.64 s): taken as not seen",
    )


def test_a_position_that_is_held_to_the_end(swing):
    frames = list(range(57, 200))
    assert judged(changed(swing, 0, frames, swing.positions[56, 0]))[0] == {"a": frames}


@pytest.mark.parametrize("first", range(70, 83))
def test_a_position_that_is_held_where_the_body_turns_back(swing, first):
    """There it neither stops nor starts suddenly; but measured positions are never the same for many frames."""
    frames = list(range(first + 1, first + 12))
    assert judged(changed(swing, 0, frames, swing.positions[first, 0]))[0] == {"a": frames}


def test_rounded_positions_that_are_held(swing):
    rounded = replace(swing, positions=np.round(swing.positions, 4))
    frames = list(range(57, 65))
    assert judged(changed(rounded, 0, frames, rounded.positions[56, 0]))[0] == {"a": frames}


# ---------------------------------------------------------------- reported


def test_a_marker_that_never_moves_is_reported(swing):
    found, doubts = judged(changed(swing, 0, slice(None), swing.positions[0, 0]))
    assert found == {}
    assert doubts == ("marker 'a' never moves at all, and others do, in frames 0 to 199 (0 to 1.99 s): was it seen?",)


def test_a_small_leap_is_reported_and_used(swing):
    found, doubts = judged(changed(swing, 1, [30, 31], swing.positions[30:32, 1] + 0.02))
    assert found == {}
    assert re.fullmatch(
        r"marker 'b' is suddenly 0\.0\d+ m away, and then back, in frames 30 to 31 \(0\.3 to 0\.31 s\): "
        r"is its label right there\?", doubts[0],
    )  # fmt: skip


def test_a_small_move_that_stays_is_reported_and_used(swing):
    found, doubts = judged(changed(swing, 1, slice(30, None), swing.positions[30:, 1] + 0.02))
    assert found == {}
    assert "marker 'b' moves suddenly by 0.0" in doubts[0]
    assert "in frames 29 to 30" in doubts[0]


@pytest.mark.parametrize(("last", "after"), [(89, " and after"), (199, "")])
def test_frames_in_which_the_recording_stops_are_reported_and_used(swing, last, after):
    positions = swing.positions.copy()
    positions[70 : last + 1] = positions[69]
    found, doubts = judged(replace(swing, positions=positions))
    assert found == {}
    assert doubts[-1] == (
        f"no marker moves at all, although they move before{after}, in frames 70 to {last} (0.7 to {0.01 * last:g} s): "
        "did the recording stop there?"
    )


def test_a_stop_is_reported_although_rounded_positions_are_equal_by_chance(swing):
    positions = swing.positions.copy()
    positions[11, 0], positions[150, 3] = positions[10, 0], positions[149, 3]
    positions[199] = positions[198]
    positions[101:115] = positions[100]
    assert any(doubt.startswith("no marker moves at all") for doubt in judged(replace(swing, positions=positions))[1])
    positions[150:157, 3] = positions[149, 3]  # such markers can stand still, and so can all
    assert not any(doubt.startswith("no marker") for doubt in judged(replace(swing, positions=positions))[1])


def test_two_markers_in_exactly_one_place_are_reported(swing):
    _, doubts = judged(changed(swing, 3, slice(None), swing.positions[:, 2]))
    where = "in frames 0 to 199 (0 to 1.99 s)"
    assert doubts == (f"marker 'd' is exactly where 'c' is {where}: is its label right there?",)


# ---------------------------------------------------------------- refused


@pytest.mark.parametrize("frame", [20, 120, 180])
@pytest.mark.parametrize("far", [0.2, 1.0, 50.0])
def test_a_leap_that_stays(swing, frame, far):
    """However long: where the marker is afterwards says nothing about the size of the body."""
    with pytest.raises(DataError) as caught:
        judged(changed(swing, 1, slice(frame, None), swing.positions[frame:, 1] + far))
    message, when = str(caught.value), f"between frames {frame - 1} and {frame} ({0.01 * frame:g} s)"
    assert message.startswith("swing.c3d: marker 'b' leaps by ")
    assert f"{when} and stays there, and the body is 0.1" in message


def test_labels_that_are_exchanged_for_good(swing):
    positions = swing.positions.copy()
    positions[120:, [0, 2]] = swing.positions[120:, [2, 0]]
    message = r"markers 'a' and 'c' exchange their places between frames 119 and 120 \(1.2 s\)"
    with pytest.raises(DataError, match=message):
        judged(replace(swing, positions=positions))


@pytest.mark.parametrize("factor", [0.001, 0.01, 0.1, 10.0, 1000.0])
@pytest.mark.parametrize("until", [130, 200])
def test_a_unit_that_changes(swing, factor, until):
    positions = swing.positions.copy()
    positions[60:until] *= factor
    message = rf"from frame 60 \(0.6 s\) on all positions are {factor:g} times what they were before: the unit changes"
    with pytest.raises(DataError, match=message):
        judged(replace(swing, positions=positions))

"""The replay log gives the same answers for the same evaluations, whatever happened to the end of its file."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.optimizers.base import TrialFailed
from cqrun.store.replay import ReplayLog


class Oracle:
    """Computes f, g and a matrix; fails if x[0] is above 2."""

    def __init__(self):
        self.calls = 0

    def __call__(self, x):
        def compute():
            self.calls += 1
            if x[0] > 2:
                raise TrialFailed("too far", body="beam", particle=np.int64(3), time=np.float64(0.5), values="µ = 3")
            return {"f": np.float64(np.sum(x**2)), "g": 2 * x, "J": np.outer(x, x)[:1]}

        return compute


def ask_all(path, points, notes=None):
    """Return the answers at all points (or the failures), the log and the oracle."""
    oracle, answers = Oracle(), []
    log = ReplayLog(path, (notes if notes is not None else []).append)
    for x in points:
        try:
            answers.append(log.evaluate("value_and_grad", x, oracle(x)))
        except TrialFailed as failure:
            answers.append(failure)
    log.close()
    return answers, log, oracle


@pytest.fixture
def points(rng):
    return [*rng.normal(size=(3, 2)), np.array([3.0, 0.0]), *rng.normal(size=(2, 2))]


def same(a, b):
    if isinstance(a, TrialFailed):
        return isinstance(b, TrialFailed) and str(a) == str(b) and vars(a) == vars(b)
    return a.keys() == b.keys() and all(a[k].shape == b[k].shape and a[k].tobytes() == b[k].tobytes() for k in a)


def test_replayed_answers_are_bit_for_bit_identical(tmp_path, points):
    first, log, _ = ask_all(tmp_path / "evals.log", points)
    assert (log.replayed, log.computed) == (0, 6)
    second, log, oracle = ask_all(tmp_path / "evals.log", points)
    assert (log.replayed, log.computed, oracle.calls) == (6, 0, 0)
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    assert first[0]["f"].shape == ()
    assert str(second[3]) == "body 'beam', particle 3, t = 0.5 s: too far; trial values: µ = 3"


def test_the_record_has_the_original_point_even_if_compute_changes_x(tmp_path):
    x = np.array([1.0, 2.0])

    def spoil():
        x[:] = 0.0
        return {"f": np.float64(1.0)}

    log = ReplayLog(tmp_path / "e")
    log.evaluate("f", x, spoil)
    log.close()
    again = ReplayLog(tmp_path / "e")
    again.evaluate("f", np.array([1.0, 2.0]), spoil)
    again.close()
    assert again.replayed == 1


def test_a_cut_at_any_byte_loses_only_the_incomplete_record(tmp_path, points):
    path = tmp_path / "evals.log"
    whole_answers, _, _ = ask_all(path, points)
    whole = path.read_bytes()
    counts = set()
    for size in range(0, len(whole), 37):
        path.write_bytes(whole[:size])
        answers, log, _ = ask_all(path, points)
        assert all(same(a, b) for a, b in zip(answers, whole_answers, strict=True))
        assert log.replayed + log.computed == 6
        assert path.read_bytes() == whole
        counts.add(log.replayed)
    assert counts == set(range(6))


def test_a_flipped_bit_is_detected_and_reported(tmp_path, points):
    path, notes = tmp_path / "evals.log", []
    whole_answers, _, _ = ask_all(path, points)
    spoilt = bytearray(path.read_bytes())
    spoilt[len(spoilt) // 2] ^= 4
    path.write_bytes(bytes(spoilt))
    answers, log, _ = ask_all(path, points, notes)
    assert all(same(a, b) for a, b in zip(answers, whole_answers, strict=True))
    assert 0 < log.replayed < 6
    assert len(notes) == 1
    assert "torn" in notes[0]


@pytest.mark.parametrize("change", ["x", "a millionth of x", "kind", "length"])
def test_another_evaluation_truncates_the_log_with_a_note(tmp_path, points, change):
    path, notes = tmp_path / "evals.log", []
    ask_all(path, points)
    size = path.stat().st_size
    log, x, kind = ReplayLog(path, notes.append), points[1], "value_and_grad"
    log.evaluate(kind, points[0], Oracle()(points[0]))
    if change == "kind":
        kind = "jacobian"
    else:
        x = {"x": x + 1.0, "a millionth of x": x * (1 + 1e-6), "length": np.append(x, 0.0)}[change]
    log.evaluate(kind, x, Oracle()(x))
    log.close()
    assert (log.replayed, log.computed) == (1, 1)
    assert len(notes) == 1
    assert "evaluation 2" in notes[0]
    assert "another point" in notes[0]
    assert path.stat().st_size < size


@pytest.mark.parametrize("rounded", [lambda x: np.nextafter(x, 9.0), lambda x: x * (1 + 1e-12)])
def test_the_log_of_a_machine_that_rounds_differently_answers_with_one_note(tmp_path, points, rounded):
    path, notes = tmp_path / "evals.log", []
    first, _, _ = ask_all(path, points)
    whole = path.read_bytes()
    second, log, oracle = ask_all(path, [points[0], *map(rounded, points[1:])], notes)
    assert (log.replayed, log.computed, oracle.calls) == (6, 0, 0)
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    assert path.read_bytes() == whole
    assert len(notes) == 1
    assert "evaluation 2 is" in notes[0]
    assert "rounds differently" in notes[0]


def test_minus_zero_is_round_off(tmp_path):
    notes = []
    log = ReplayLog(tmp_path / "e")
    log.evaluate("f", np.array([0.0]), lambda: {"f": np.float64(1)})
    log.close()
    again = ReplayLog(tmp_path / "e", notes.append)
    again.evaluate("f", np.array([-0.0]), lambda: {"f": np.float64(2)})
    again.close()
    assert (again.replayed, again.computed, len(notes)) == (1, 0, 1)


def test_an_interrupted_computation_leaves_no_record(tmp_path):
    def interrupted():
        raise KeyboardInterrupt

    log = ReplayLog(tmp_path / "e")
    with pytest.raises(KeyboardInterrupt):
        log.evaluate("f", np.zeros(1), interrupted)
    log.close()
    assert (tmp_path / "e").stat().st_size == 12


def test_a_file_that_is_not_a_log_is_refused(tmp_path):
    (tmp_path / "e").write_bytes(b"something else altogether")
    with pytest.raises(UsageError, match=r"unreadable checkpoint.*--fresh"):
        ReplayLog(tmp_path / "e")
    assert (tmp_path / "e").read_bytes() == b"something else altogether"

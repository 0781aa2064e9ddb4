"""`cqrun control`: what it learns and writes, how it stops and goes on."""

from __future__ import annotations

import csv
import sys

import numpy as np
import pytest
from small_beam import Listener, assert_same, changed, result_of
from small_finger import written

from cqrun.controllers.saved import read_controller
from cqrun.errors import RolloutError, RunError, SceneError, Stopped, UsageError
from cqrun.figures.draw import draw_run
from cqrun.jobs.control import run_control
from cqrun.jobs.resume import run_resume
from cqrun.jobs.table import report_lines
from cqrun.learning.episodes import EpisodeProblem
from cqrun.running.runs import EXTENDED
from cqrun.store.history import read_history
from cqrun.store.run import read_record
from cqrun.store.trajectory import read_trajectory


@pytest.fixture
def finger(tmp_path):
    """Return the scene of the small finger."""
    return written(tmp_path)


def learn(scene, out, *overrides, reporter=None, threads=1, fresh=False):
    return run_control(scene, overrides, out, fresh=fresh, threads=threads, reporter=reporter)


def test_it_learns_and_writes_what_it_learned(finger, tmp_path):
    run = learn(finger, tmp_path)
    result, history = result_of(run), read_history(run / "history.csv")
    assert (result["job"], result["status"], result["iterations"]) == ("control", "iteration_limit", 4)
    assert result["trained"]["loss"] < 0.8 * result["start"]["loss"]
    assert result["loss"] == pytest.approx(result["trained"]["loss"], rel=1e-12)
    assert history["loss"][0] == pytest.approx(result["start"]["loss"], rel=1e-12)
    assert len(history["loss"]) == 5
    for name in ("tip", "effort", "growth_at", "grad:controller.weights", "grad:controller.biases"):
        assert np.isfinite(history[name]).all()
    terms = [history["tip"][k] + 1e-3 * history["effort"][k] for k in range(5)]
    np.testing.assert_allclose(history["loss"], terms, rtol=1e-12)
    assert len(result["trained"]["episodes"]) == 2
    assert len(result["unseen"]["episodes"]) == 1
    goals = [tuple(e["goals"]["target"]) for key in ("trained", "unseen") for e in result[key]["episodes"]]
    assert len(set(goals)) == 3
    assert np.all(np.abs(np.array(goals) - 0.6) <= 0.05)
    parameters, meta = read_controller(run / "controller.npz")
    assert {name: array.shape for name, array in parameters.items()} == {"weights": (2, 15), "biases": (2,)}
    assert meta["actuators"] == ["muscle.left", "muscle.right"]
    motion = read_trajectory(run / "trajectory.h5")
    assert (motion.complete, len(motion.time)) == (True, 11)
    rows = list(csv.DictReader((run / "activation.csv").read_text().splitlines()))
    assert list(rows[0]) == ["time", "muscle.left", "muscle.right"]
    left = [float(row["muscle.left"]) for row in rows]
    assert len(left) == 10
    np.testing.assert_allclose(motion.fields["activation"][1:, 0], left, rtol=1e-6)
    text = "\n".join(report_lines(run))
    assert text.startswith("iteration_limit after 4 iterations")
    assert "term    before" in text
    assert "on unseen goals" in text


def test_an_unseen_goal_at_which_the_body_blows_up_costs_no_result(finger, tmp_path, monkeypatch):
    attempt = EpisodeProblem.attempt

    def blow_up(problem, values, goals, *rest):
        if np.array_equal(goals["target"], problem.unseen()[1]["target"]):
            raise RolloutError("left the grid", body="finger", particle=3, time=0.2, advice="enlarge the world")
        return attempt(problem, values, goals, *rest)

    monkeypatch.setattr(EpisodeProblem, "attempt", blow_up)
    run = learn(finger, tmp_path, "episodes.unseen=3")
    result = result_of(run)
    (lost,) = result["blew_up"]["unseen"]
    assert len(result["unseen"]["episodes"]) == 2
    assert lost["goals"]["target"] not in [e["goals"]["target"] for e in result["unseen"]["episodes"]]
    told = "on unseen goals: 1 of 3 episodes blew up and is in no mean: body 'finger', particle 3, t = 0.2 s"
    assert any(line.startswith(told) for line in report_lines(run))
    assert told in (run / "log.txt").read_text()


@pytest.mark.parametrize("unseen_too", [True, False])
def test_a_controller_under_which_every_episode_blows_up_is_an_error(finger, tmp_path, monkeypatch, unseen_too):
    """Also where it goes well with goals that it has not seen: a loss of nothing could not be compared."""
    attempt = EpisodeProblem.attempt

    def blow_up(problem, values, goals, *rest):
        if not unseen_too and any(np.array_equal(goals["target"], goal["target"]) for goal in problem.unseen()):
            return attempt(problem, values, goals, *rest)
        raise RolloutError("left the grid", body="finger", particle=3, time=0.2, advice="enlarge the world")

    monkeypatch.setattr(EpisodeProblem, "attempt", blow_up)
    with pytest.raises(RolloutError, match="left the grid"):
        learn(finger, tmp_path, "episodes.unseen=1")


@pytest.mark.parametrize("method", ["slsqp", "sqp", "trust_constr", "augmented_lagrangian"])
def test_solvers_for_constraints_learn_without_any(finger, tmp_path, method):
    run = learn(finger, tmp_path, f"optimizer={{{method}: {{max_iterations: 4}}}}")
    result = result_of(run)
    assert (result["status"], result["iterations"]) == ("iteration_limit", 4)
    assert result["trained"]["loss"] < 0.95 * result["start"]["loss"]


def test_the_same_again_is_finished_and_more_iterations_extend_it(finger, tmp_path):
    run = learn(finger, tmp_path / "out")
    listener = Listener()
    assert learn(finger, tmp_path / "out", reporter=listener) == run
    assert listener.said == ["finished already (iteration_limit); --fresh starts over"]
    assert run_resume(run, ["optimizer.adam.max_iterations=6"], threads=1) == run
    assert_same_learning(run, learn(finger, tmp_path / "long", "optimizer.adam.max_iterations=6"))
    with pytest.raises(UsageError, match="a run can only be extended"):
        run_resume(run, ["time.duration=1"], threads=1)


def assert_same_learning(run, other):
    """Fail where two runs of differently written scenes learned different things."""
    first, second = (read_controller(path / "controller.npz")[0] for path in (run, other))
    assert all(np.array_equal(first[name], second[name]) for name in second)
    assert {k: v for k, v in read_history(run / "history.csv").items() if k != "seconds"} == {
        k: v for k, v in read_history(other / "history.csv").items() if k != "seconds"
    }


@pytest.mark.parametrize(
    ("rate", "weight", "told"),
    [
        (0.1, 0.001, None),
        (0.5, 0.05, "the result is iterate 3, the best of 5"),
        (0.5, 0.1, "the result is the start: none of 5 iterates is better"),
    ],
)
def test_a_result_that_is_not_the_last_iterate_is_told(finger, tmp_path, rate, weight, told):
    changed(
        finger, "adam: {learning_rate: 0.1, max_iterations: 4}", f"adam: {{learning_rate: {rate}, max_iterations: 5}}"
    )
    run = learn(finger, tmp_path, f"objective.effort.effort.weight={weight}")
    losses = read_history(run / "history.csv")["loss"]
    best = int(np.argmin(losses))
    assert best == {None: 5, "the result is iterate 3, the best of 5": 3}.get(told, 0)
    assert result_of(run)["loss"] == losses[best]
    assert report_lines(run)[1] == (told or "")


def test_threads_do_not_change_a_bit(finger, tmp_path):
    assert_same(learn(finger, tmp_path / "1", threads=1), learn(finger, tmp_path / "2", threads=2))


@pytest.mark.parametrize("fresh", ["true", "false"])
def test_stopped_and_resumed_is_the_same(finger, tmp_path, fresh):
    changed(finger, "unseen: 1", f"unseen: 1, fresh: {fresh}")
    whole = learn(finger, tmp_path / "whole")
    with pytest.raises(Stopped, match=r"asked to stop after iteration 2; `cqrun resume .*` continues"):
        learn(finger, tmp_path, reporter=Listener(stop_after=2))
    run = tmp_path / whole.relative_to(tmp_path / "whole")
    assert read_record(run)["status"] == "stopped"
    run_resume(run, [], threads=1)
    assert_same(run, whole)


def test_unknowns_are_learned_beside_the_controller(finger, tmp_path):
    path = "actuators.muscle.muscle.strength"
    run = learn(finger, tmp_path, f"unknowns={{{path}: {{bounds: [2, 8]}}}}")
    learned = result_of(run)["unknowns"][path]
    assert learned["initial"] == 4.0
    assert learned["value"] != 4.0
    assert read_controller(run / "controller.npz")[1]["unknowns"] == {path: learned["value"]}


def test_a_start_that_blows_up_is_told(finger, tmp_path):
    floor = "{friction: {face: y_min, coefficient: 0.5}}"  # four times, so that the kernels are those of four walls
    floors = "\n  ".join(f"{name}: {floor}" for name in "abcd")
    changed(finger, "walls: {friction: {face: all, coefficient: 0.5}}", floors)
    changed(finger, "corner: [-1, -1], size: [3, 1.31]", "corner: [0.9, 0.9], size: [1, 1]")
    changed(finger, "place:", "velocity: [10, 0]\n    place:")
    changed(finger, "substeps: 2", "substeps: auto")
    listener = Listener()
    with pytest.raises(RunError, match=r"body 'finger', particle \d+, t = .* left the grid"):
        learn(finger, tmp_path, reporter=listener)
    assert not any("the gradient was zero" in line for line in listener.said)
    (run,) = (tmp_path / "finger").iterdir()
    assert result_of(run)["trained"] is None
    assert report_lines(run)[0].startswith("failed after 0 iterations")


def test_regions_of_the_scene_serve_as_groups(finger, tmp_path):
    """A centroid, a distance and a constraint of a region are those of the group that holds the same particles."""
    same = ["regions={there: {union: [left, right]}}", "optimizer.adam.max_iterations=1"]
    found = []
    for name in ("left", "there"):
        parts = {"left": "[left]", "there": "[there]"}[name]
        region = "regions={there: {union: [left]}}"
        run = learn(
            finger, tmp_path, region, *same[1:], f"observers.parts.centroids.groups={parts}",
            f"objective.far={{distance: {{body: finger, group: {name}, axis: x}}}}",
        )  # fmt: skip
        found.append(read_history(run / "history.csv"))
    for column in ("loss", "far", "grad:controller.weights"):
        assert found[0][column] == found[1][column]
    assert found[0]["far"][1] != 0.0


def test_a_zero_gradient_is_reported(finger, tmp_path):
    """At rest the greatest distance is that of the first step, which no activation has moved."""
    listener = Listener()
    run = learn(
        finger, tmp_path, "objective={far: {distance: {body: finger, over: maximum}}}",
        "controller={open_loop: {every: 5}}", "goals={}", "episodes={}", "observers={}", reporter=listener,
    )  # fmt: skip
    told = [line for line in listener.said if "the gradient was zero at every iteration" in line]
    assert len(told) == 1
    assert "zero at every iteration" in (run / "log.txt").read_text()
    listener = Listener()
    learn(finger, tmp_path, reporter=listener)
    assert not any("the gradient was zero" in line for line in listener.said)


@pytest.mark.parametrize(("range_", "told"), [("[-1, 1]", True), ("[-0.001, 0.001]", False)])
def test_a_network_that_hardly_feels_its_body_is_told(finger, tmp_path, range_, told):
    """Whatever a clock beside it does."""
    listener = Listener()
    parts = f"observers.parts.centroids.range={{position: {range_}, velocity: {range_}}}"
    wanted = ["controller={mlp: {hidden: [4]}}", parts]
    run = learn(finger, tmp_path, *wanted, reporter=listener)
    found = [text for text in listener.said if "hardly changes" in text]
    assert len(found) == (1 if told else 0)
    assert ("hardly changes" in (run / "log.txt").read_text()) is told
    assert all("observers.parts: " in text and " of the range -1 to 1 " in text for text in found)


def test_an_extended_run_is_told_where_fewer_iterations_are_asked_for(finger, tmp_path):
    run = learn(finger, tmp_path)
    run_resume(run, ["optimizer.adam.max_iterations=5"], threads=1)
    listener = Listener()
    assert learn(finger, tmp_path, reporter=listener) == run
    assert f"warning: {run}: {EXTENDED}; --fresh starts over" in listener.said


@pytest.mark.parametrize(
    "wanted", [["optimizer={cma_es: {max_iterations: 1}}"], ["actuators.muscle.muscle.strength=0"]]
)
def test_a_network_without_gradients_is_drawn(finger, tmp_path, wanted):
    """Neither a method of values alone has norms to draw, nor muscles without strength."""
    no_effort = "objective={tip: {reach: {body: finger, group: tip, goal: target}}}"
    run = learn(finger, tmp_path, "controller={mlp: {hidden: [4, 4]}}", no_effort, *wanted)
    assert run / "figures" / "convergence.png" in draw_run(run)


def test_a_missing_cma_is_named_before_anything_runs(finger, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(SceneError, match=r"optimizer.cma_es: .*'cma', which is not installed: pip install"):
        learn(finger, tmp_path, "optimizer={cma_es: {}}")


def test_a_run_begins_with_a_line_on_each_body(finger, tmp_path):
    listener = Listener()
    run = learn(finger, tmp_path, "optimizer.adam.max_iterations=1", reporter=listener)
    told = "finger: 48 particles, 4 per cell, 0.05 m apart; mass 48 kg/m; from (0.4125, 0.25) to "
    assert any(line.startswith(told) and line.endswith("face of the world of 1 x 1 m") for line in listener.said)
    assert told in (run / "log.txt").read_text()


def test_recordings_that_control_does_not_read_are_told(finger, tmp_path):
    listener = Listener()
    data = "data={recordings: {one: {file: absent.csv, body: finger}}}"
    learn(finger, tmp_path, data, "optimizer.adam.max_iterations=1", reporter=listener)
    assert any(line.endswith("data: control reads no recordings; `cqrun sysid` does") for line in listener.said)

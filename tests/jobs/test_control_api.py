"""Scenes that act, from Python and under `cqrun gradcheck`: the loss of episodes by a controller's parameters."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_beam import result_of
from small_finger import FINGER, written

import cqrun
from cqrun.errors import SceneError, UsageError
from cqrun.jobs.control import run_control
from cqrun.jobs.gradcheck import ALL, run_gradcheck
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.store.history import read_history
from cqrun.store.trajectory import read_trajectory

WEIGHTS, BIASES, STRENGTH = "controller.weights", "controller.biases", "actuators.muscle.muscle.strength"


@pytest.fixture(scope="module")
def problem():
    return cqrun.load(FINGER, threads=1)


def test_params_are_the_controllers_as_it_starts(problem):
    assert {name: value.shape for name, value in problem.params.items()} == {WEIGHTS: (2, 15), BIASES: (2,)}
    assert not problem.params[BIASES].any()
    assert problem.params[WEIGHTS].std() == pytest.approx(0.02, rel=0.5)


def test_the_loss_is_that_of_control(problem, tmp_path):
    loss, gradient, aux = problem.value_and_grad()
    run = run_control(written(tmp_path), ["optimizer.adam.max_iterations=1"], tmp_path, threads=1)
    history = read_history(run / "history.csv")
    assert loss == pytest.approx(history["loss"][0], rel=1e-12)
    assert np.linalg.norm(gradient[WEIGHTS]) == pytest.approx(history[f"grad:{WEIGHTS}"][0], rel=1e-12)
    assert gradient[WEIGHTS].shape == (2, 15)
    episodes = result_of(run)["start"]["episodes"]
    assert list(aux["losses"].values()) == pytest.approx([e["loss"] for e in episodes], rel=1e-12)
    assert [goals["target"].tolist() for goals in aux["goals"]] == [e["goals"]["target"] for e in episodes]
    assert aux["terms"]["tip"] == pytest.approx(history["tip"][0], rel=1e-12)
    assert aux["constraints"] == {}
    assert aux["gradient"]["recompute_factor"] == 1.0


def test_gradients_are_those_of_differences(problem, rng):
    """By parameters, and by a number that is no unknown."""
    at = {WEIGHTS: 0.1 * rng.normal(size=(2, 15)), STRENGTH: 4.5}
    _, gradient, _ = problem.value_and_grad(at)
    assert gradient.keys() == {WEIGHTS, BIASES, STRENGTH}
    assert isinstance(gradient[STRENGTH], float)
    step = {WEIGHTS: rng.normal(size=(2, 15)), STRENGTH: 1.0}
    h = 1e-4
    ahead, behind = (problem.value_and_grad({k: at[k] + s * h * step[k] for k in at})[0] for s in (1, -1))
    along = np.sum(gradient[WEIGHTS] * step[WEIGHTS]) + gradient[STRENGTH]
    assert along == pytest.approx((ahead - behind) / (2 * h), rel=1e-5)


def test_simulate_is_the_job(problem, tmp_path):
    motion = problem.simulate()
    run = run_simulate(written(tmp_path), [], tmp_path, threads=1)
    np.testing.assert_array_equal(motion.x, read_trajectory(run / "trajectory.h5").fields["x"])
    table = np.loadtxt(run / "activation.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(motion.activation, table[:, 1:])


def test_jobs_take_text_for_paths(tmp_path):
    short = ["time.duration=0.02", "optimizer.adam.max_iterations=1"]
    run = run_control(str(written(tmp_path)), short, str(tmp_path / "out"), threads=1)
    assert run.parent.name == "finger"
    assert run_resume(str(run), [], threads=1) == run
    again = run_simulate(str(run), [], str(tmp_path / "again"), threads=1)
    other = run_simulate(str(run), [], str(tmp_path / "again"), controller=str(run / "controller.npz"), threads=1)
    assert again == other


def test_simulate_takes_parameters_and_goals(problem):
    still = problem.simulate({WEIGHTS: np.zeros((2, 15))})
    assert not still.activation.any()
    np.testing.assert_allclose(still.x, np.broadcast_to(still.x[0], still.x.shape), rtol=0, atol=1e-14)
    assert not np.array_equal(problem.simulate(goals={"target": [0.4, 0.6]}).x, problem.simulate().x)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"controller.weigths": np.zeros((2, 15))}, r"no block of the controller \(did you mean 'controller.w"),
        ({WEIGHTS: np.zeros((2, 14))}, r"controller.weights: a value of shape \(2, 14\); it must be one of \(2, 15\)"),
        ({BIASES: np.array([0.0, np.nan])}, "controller.biases: must be finite"),
    ],
)
def test_parameters_that_cannot_be_are_refused(problem, params, message):
    with pytest.raises(UsageError, match=message):
        problem.value_and_grad(params)


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ({"traget": [0.5, 0.5]}, r"there is no 'traget' \(did you mean 'target'\?\); there are: target"),
        ({"target": [0.5]}, r"'target' must be 2 finite numbers, is \[0.5\]"),
        ({"target": "x"}, "goals: 'target': must be a number or an array of numbers, is 'x'"),
    ],
)
def test_goals_that_cannot_be_are_refused(problem, goals, message):
    with pytest.raises(UsageError, match=message):
        problem.simulate(goals=goals)


def test_a_run_is_loaded_with_the_controller_that_it_trained(tmp_path):
    """And with the strength that was learned beside it; longer, the clock's period is that of the training."""
    text = FINGER.replace(", spread: [0.05, 0.05]", "") + f"unknowns: {{{STRENGTH}: {{bounds: [2, 8]}}}}\n"
    run = run_control(written(tmp_path, text), [], tmp_path / "out", threads=1)
    problem = cqrun.load(run, threads=1)
    assert (problem.found.keys(), problem.params[STRENGTH]) == ({WEIGHTS, BIASES, STRENGTH}, 4.0)
    result, x = result_of(run), read_trajectory(run / "trajectory.h5").fields["x"]
    assert problem.value_and_grad()[0] == pytest.approx(result["start"]["loss"], rel=1e-12)
    assert problem.value_and_grad(problem.found)[0] == pytest.approx(result["trained"]["loss"], rel=1e-12)
    np.testing.assert_array_equal(problem.simulate(problem.found).x, x)
    longer = cqrun.load(run, ["time.duration=0.15"], threads=1)
    np.testing.assert_array_equal(longer.simulate(longer.found).x[:11], x)


def test_without_an_objective_it_acts_but_has_no_loss():
    text = FINGER.replace("job: control\n", "")
    without = text[: text.index("objective:")] + text[text.index("time:") :]
    acting = cqrun.load(without, threads=1)
    assert acting.params.keys() == {WEIGHTS, BIASES}
    assert acting.simulate().activation.shape == (10, 2)
    with pytest.raises(UsageError, match="neither `data` nor an `objective`, so there is no loss"):
        acting.value_and_grad()


@pytest.mark.parametrize("controller", ["linear_tanh: {}", "open_loop: {every: 3, interpolate: linear}"])
def test_gradcheck_is_of_the_first_episode(tmp_path, controller):
    unknown = f"unknowns={{{STRENGTH}: {{bounds: [2, 8]}}}}"
    overrides = [f"controller={{{controller}}}", unknown]
    run, agrees = run_gradcheck(written(tmp_path), overrides, tmp_path, threads=1)
    found = json.loads((run / "gradcheck.json").read_text())
    assert agrees
    assert found["of"] == "the first episode's loss"
    blocks = [WEIGHTS, BIASES] if controller.startswith("linear") else ["controller.knots"]
    assert [row["block"] for row in found["rows"]] == [*blocks, STRENGTH, ALL]
    assert all(row["error"] < 1e-6 for row in found["rows"] if row["adjoint"])
    if controller.startswith("linear"):
        loss = cqrun.load(FINGER, threads=1).value_and_grad()[2]["losses"]["episode 0"]
        assert found["loss"] == pytest.approx(loss, rel=1e-12)


def test_a_scene_that_does_not_fit_leaves_no_run_of_gradcheck(tmp_path):
    overrides = ["observers.parts={clusters: {body: finger, count: 49}}"]
    with pytest.raises(SceneError, match=r"observers.parts: 49 clusters of 48 particles"):
        run_gradcheck(written(tmp_path), overrides, tmp_path / "out", threads=1)
    assert not (tmp_path / "out").exists()

"""Learning as an optimizer sees it: values and gradients of episodes, goals that are drawn, trials that fail."""

from __future__ import annotations

import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.model import build
from cqrun.errors import SceneError, UsageError
from cqrun.jobs.control import CONTROL
from cqrun.learning.agent import Agent
from cqrun.learning.episodes import EpisodeProblem
from cqrun.learning.record_memory import record_bytes
from cqrun.optimizers.base import TrialFailed
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene

FINGER = Path(__file__).parents[2] / "scenes" / "control" / "finger.yaml"
SMALL = ["bodies.finger.sampling.lattice.count=6", "time.duration=0.04"]
DRAWN = ["goals.target.spread=[0.05, 0.05]", "episodes.count=3", "episodes.seed=5"]
STRENGTH = "unknowns={actuators.muscle.muscle.strength: {bounds: [1, 1.0e+7], scale: log}}"
SHIFT = 0.1


def finger(*overrides: str, threads: int = 1) -> EpisodeProblem:
    """Return the finger with 108 particles and 8 control steps."""
    return EpisodeProblem(Agent(build(load_scene(FINGER, [*SMALL, *overrides]))), threads=threads)


def aims(problem: EpisodeProblem, batch: tuple[int, ...] | None = None) -> np.ndarray:
    """Return the goals of a batch's episodes (E, 2)."""
    return np.array([goals["target"] for goals in problem.goals(batch)])


@pytest.mark.parametrize("overrides", [[], DRAWN, [*DRAWN, "episodes.fresh=true"]], ids=["fixed", "set", "fresh"])
def test_the_value_is_that_of_value_and_grad(overrides, rng):
    problem = finger(*overrides)
    x = problem.start + SHIFT * rng.normal(size=len(problem.start))
    batch = (7,) if problem.stochastic else None
    value, gradient = problem.value_and_grad(x, batch)
    assert problem.value(x, batch) == value
    assert problem.values_at([x, problem.start], batch) == [value, problem.value(problem.start, batch)]
    assert gradient.shape == x.shape
    assert problem.lower.shape == problem.upper.shape == x.shape


@pytest.mark.parametrize("block", ["controller.weights", "controller.biases", "actuators.muscle.muscle.strength"])
def test_the_gradient_is_that_of_differences(block, rng):
    """Controller and unknowns, by Richardson's extrapolation of central differences."""
    problem = finger(*DRAWN, STRENGTH)
    x = problem.start + SHIFT * rng.normal(size=len(problem.start))
    x[-1] = problem.start[-1]
    way = np.zeros(len(x))
    way[problem.params.slices[block]] = 1.0
    _, gradient = problem.value_and_grad(x)
    slopes = [(problem.value(x + h * way) - problem.value(x - h * way)) / (2 * h) for h in (2e-3, 1e-3)]
    assert abs(gradient @ way) > 0
    assert gradient @ way == pytest.approx((4 * slopes[1] - slopes[0]) / 3, rel=1e-7)


def test_the_loss_is_the_mean_over_episodes(rng):
    problem = finger(*DRAWN)
    x = problem.start + SHIFT * rng.normal(size=len(problem.start))
    alone = [problem.value_and_grad(x, (e,)) for e in range(3)]
    assert len({value for value, _ in alone}) == 3
    value, gradient = problem.value_and_grad(x)
    assert value == pytest.approx(np.mean([v for v, _ in alone]), rel=1e-14)
    np.testing.assert_allclose(gradient, np.mean([g for _, g in alone], axis=0), rtol=0, atol=1e-15)
    pair = problem.value(x, (0, 2))
    assert pair == pytest.approx((alone[0][0] + alone[2][0]) / 2, rel=1e-14)
    np.testing.assert_array_equal(problem.term_values()[:1], [pair])


def test_every_term_is_evaluated_once(monkeypatch):
    problem, asked = finger(), []
    for name, bound in problem.agent.objective.terms.items():
        monkeypatch.setattr(bound, "value", lambda track, name=name, own=bound.value: asked.append(name) or own(track))
    problem.value(problem.start)
    assert asked == list(problem.agent.objective.terms)


def test_an_episode_that_is_done_keeps_no_grid(monkeypatch):
    problem, alive = finger(*DRAWN), []
    rollout = problem.agent.rollout

    def made(*args, **kwargs):
        assert not any(each() for each in alive), "the last one's arrays"
        found = rollout(*args, **kwargs)
        alive.append(weakref.ref(found))
        return found

    monkeypatch.setattr(problem.agent, "rollout", made)
    problem.value_and_grad(problem.start)
    problem.value(problem.start)
    assert len(alive) == 2 * problem.n_episodes


def test_records_that_do_not_fit_are_refused(monkeypatch):
    scene = load_scene(FINGER, [*SMALL, "objective.whole={stretch: {body: finger}}", "optimizer={adam: {}}"])
    problem = CONTROL.prepare(scene, 1, Silent())
    need = record_bytes(problem.agent, 1)
    for spare, refused in ((0, False), (-1, True)):
        memory = SimpleNamespace(available=need + spare, total=2 * need)
        with monkeypatch.context() as patch:
            patch.setattr("cqrun.build.particles.require_memory", lambda *_: None)
            patch.setattr("psutil.virtual_memory", lambda memory=memory: memory)
            if refused:
                with pytest.raises(SceneError, match=r"objective.whole: 108 of .* at 8 control steps, by 1 ep"):
                    CONTROL.prepare(scene, 1, Silent())
            else:
                CONTROL.prepare(scene, 1, Silent())


@needs_jit
def test_episodes_side_by_side_change_no_bit(rng):
    x = 0.1 * rng.normal(size=len(finger().start))
    one, two = (finger(*DRAWN, threads=threads).value_and_grad(x) for threads in (1, 2))
    assert one[0] == two[0]
    np.testing.assert_array_equal(one[1], two[1])


def test_a_fixed_set_stays_and_its_batches_are_of_it():
    problem = finger(*DRAWN)
    assert (problem.stochastic, problem.n_batches, problem.n_episodes) == (False, 3, 3)
    whole = aims(problem)
    assert len(np.unique(whole, axis=0)) == 3
    np.testing.assert_array_equal(aims(problem, (2, 0)), whole[[2, 0]])
    np.testing.assert_array_equal(aims(finger(*DRAWN)), whole)
    assert (np.abs(whole - [0.6, 0.6]) <= 0.05).all()
    assert np.abs(whole - [0.6, 0.6]).max() > 0.01


def test_fresh_goals_differ_by_iteration_and_repeat_by_seed():
    problem = finger(*DRAWN, "episodes.fresh=true")
    assert (problem.stochastic, problem.n_batches) == (True, 1)
    drawn = [aims(problem, (k,)) for k in range(4)]
    assert len(np.unique(np.concatenate(drawn), axis=0)) == 12
    np.testing.assert_array_equal(aims(finger(*DRAWN, "episodes.fresh=true"), (3,)), drawn[3])
    other = aims(finger(*DRAWN, "episodes.fresh=true", "episodes.seed=6"), (3,))
    assert not np.isin(other, drawn[3]).any()


def test_unseen_goals_are_none_of_those_it_learns_from():
    problem = finger(*DRAWN, "episodes.fresh=true", "episodes.unseen=20")
    unseen = np.array([goals["target"] for goals in problem.unseen()])
    assert len(np.unique(unseen, axis=0)) == 20
    assert (np.abs(unseen - [0.6, 0.6]) <= 0.05).all()
    seen = np.concatenate([aims(problem, (k,)) for k in range(50)])
    assert not np.isin(unseen, seen).any()
    assert finger(*DRAWN).unseen() == []


def test_one_episode_where_no_goal_is_drawn():
    problem = finger("episodes.count=3", "episodes.fresh=true")
    assert (problem.stochastic, problem.n_episodes) == (False, 1)
    np.testing.assert_array_equal(aims(problem), [[0.6, 0.6]])


@needs_jit
def test_a_blow_up_is_a_failed_trial_with_its_values():
    problem = finger(STRENGTH, "time.duration=0.1")
    x = problem.start + 1.0
    x[-1] = 1.0
    with pytest.raises(TrialFailed, match="finger") as caught:
        problem.value_and_grad(x)
    assert caught.value.values.endswith("actuators.muscle.muscle.strength = 1e+07")
    with pytest.raises(TrialFailed):
        problem.value(x)
    failed, done = problem.values_at([x, problem.start])
    assert isinstance(failed, TrialFailed)
    assert isinstance(done, float)


def test_least_squares_is_refused():
    problem = finger()
    for call in (problem.residuals, problem.residuals_and_jacobian):
        with pytest.raises(UsageError, match="take adam, sgd, lbfgs or cma_es"):
            call(problem.start)

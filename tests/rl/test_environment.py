"""A scene as a Gymnasium environment, and PPO on it (extra `rl`; `make test-rl`)."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from small_disc import DISC, FORCES, MOTION, TENSION
from small_finger import DESIGN, STIFFNESS

import cqrun
from cqrun.build.model import build
from cqrun.engine.model import Records
from cqrun.errors import SceneError, UsageError
from cqrun.learning.agent import Agent
from cqrun.running.runs import open_run
from cqrun.scene.load import load_scene

pytestmark = pytest.mark.rl
FINGER = "scenes/control/finger.yaml"
SMALL = ["bodies.finger.sampling.lattice.count=8", "time.duration=0.05"]


@pytest.fixture
def env():
    """Return a small finger that reaches for a goal drawn anew."""
    return cqrun.environment(FINGER, [*SMALL, "goals.target.spread=[0.1, 0.1]"], threads=1)


@pytest.mark.filterwarnings("ignore:.*infinity")  # observations have no bounds: a body may go anywhere
def test_gymnasium_accepts_it(env):
    from gymnasium.utils.env_checker import check_env

    check_env(env, skip_render_check=True)


def test_rewards_sum_to_what_the_loss_fell_by(env):
    env.reset(seed=3)
    first, total, over, steps = env.loss, 0.0, False, 0
    while not over:
        seen, reward, failed, over, facts = env.step(env.action_space.sample())
        total, steps = total + reward, steps + 1
        assert not failed
        assert env.observation_space.contains(seen)
    assert steps == env.agent.model.n_controls
    assert total == pytest.approx(first - facts["loss"], abs=1e-15)


def test_it_moves_as_the_policy_does(env):
    """The same activations, one control step at a time, give the bits of a whole rollout."""
    agent = env.agent
    env.reset(seed=5)
    while env.control < agent.model.n_controls:
        values = {p.removeprefix("controller."): v for p, v in agent.acting.items()}
        env.step(agent.controller.act(values, env.observation, env.control, 0.0))
    whole = agent.rollout(agent.acting, env.goals, 1)
    found = agent.judged(whole, whole.run(), env.goals)
    np.testing.assert_array_equal(env.rollout.records, whole.records)
    assert env.loss == found.loss


def test_rigid_bodies_and_forces_are_seen_as_the_policy_sees_them():
    """At every step, with the forces of the step before, and activations that the caller chose."""
    env = cqrun.environment({**DISC, "unknowns": {}, "observers": MOTION | FORCES | TENSION}, threads=1)
    agent, (seen, _) = env.agent, env.reset(seed=1)
    values, found = {p.removeprefix("controller."): v for p, v in agent.acting.items()}, [seen]
    while env.control < agent.model.n_controls:
        found.append(env.step(agent.controller.act(values, env.observation, env.control, 0.0))[0])
    whole = agent.rollout(agent.acting, env.goals, 1)
    judged = agent.judged(whole, whole.run(), env.goals)
    np.testing.assert_array_equal(found[:-1], judged.observations)
    assert env.loss == judged.loss


def test_an_action_that_is_not_finite_is_refused(env):
    """It is the learner's mistake, no blow-up; the episode goes on."""
    env.reset(seed=1)
    with pytest.raises(UsageError, match=r"step: an action has finite numbers, not \[nan"):
        env.step(np.array([np.nan, 0.0]))
    *_, failed, _, _ = env.step(np.zeros(2))
    assert not failed


def test_a_blow_up_ends_the_episode_and_never_pays(env):
    """Not even where the loss only grows: the episode's rewards sum to less than there was at any step of any other."""
    env.reset(seed=1)
    first, sums = env.loss, [0.0]
    while not env.over:
        sums.append(sums[-1] + env.step(np.full(2, -1.0))[1])
    env.reset(seed=1)
    so_far = env.step(np.ones(2))[1]
    env.states[...] = np.nan
    _, reward, failed, over, facts = env.step(np.zeros(2))
    assert (failed, over) == (True, False)
    assert "not finite" in facts["failed"]
    least, most = min(*sums, so_far), max(*sums, so_far)
    assert so_far + reward == pytest.approx(least - (most - least) - first, rel=1e-12)


def test_a_step_reads_its_own_record_alone(env, monkeypatch):
    """The whole run's, copied at every step, took most of the time."""
    env.reset(seed=1)
    read, whole = [], Records.from_rows
    monkeypatch.setattr(Records, "from_rows", lambda rows, dim: read.append(len(rows)) or whole(rows, dim))
    env.step(np.ones(2))
    assert read == [1]
    assert env.track.x.shape[1] == env.agent.objective.rows.shape[0]


def test_constraints_are_refused_and_a_design_that_is_not_learned_is_told():
    with pytest.raises(SceneError, match="constraints: an environment does not support constraints: make them wei"):
        cqrun.environment(DESIGN, threads=1)
    with pytest.warns(UserWarning, match=f"unknowns: {STIFFNESS} stay at their start: an environment learns no design"):
        cqrun.environment(DESIGN, ["constraints={}"], threads=1)


def test_a_run_acts_with_what_it_has_designed(tmp_path):
    strength = "actuators.muscle.muscle.strength"
    scene = load_scene(DESIGN, ["constraints={}", f"unknowns.{strength}={{bounds: [2, 6]}}"])
    with open_run("finger", scene, tmp_path, job="codesign", threads=1, fresh=False) as begun:
        run = begun.path
    with pytest.raises(UsageError, match=r"has found no design yet .*; -o unknowns={} takes its scene's own"):
        cqrun.environment(run, threads=1)
    agent = Agent(build(scene))
    learned = {block.path: 1.1 * block.initial for block in agent.params.blocks}
    agent.save(run / "controller.npz", learned)
    env = cqrun.environment(str(run), threads=1)
    env.reset(seed=0)
    own = {path: learned[path] for path in (STIFFNESS, strength)}
    inputs, wanted = env.rollout.inputs, agent.built.assembly.inputs(own)
    np.testing.assert_array_equal(inputs.strength, wanted.strength)
    np.testing.assert_array_equal(inputs.terms[0][0], wanted.terms[0][0])
    assert cqrun.environment(run, [f"{strength}=5"], threads=1).design.keys() == {STIFFNESS}
    with pytest.raises(UsageError, match="has a value of it for every group or particle"):
        cqrun.environment(run, [f"{STIFFNESS}=12"], threads=1)
    with pytest.raises(UsageError, match=r"holds 48 numbers of .* bodies and particles must be those"):
        cqrun.environment(run, ["bodies.finger.sampling.lattice.count=3"], threads=1)


def test_a_step_out_of_turn_is_told(env):
    with pytest.raises(UsageError, match=r"none has begun; call reset\(\) first"):
        env.step(np.zeros(2))
    env.reset(seed=1)
    with pytest.raises(UsageError, match=r"an action has shape \(2,\), not \(3,\)"):
        env.step(np.zeros(3))
    while not env.step(np.zeros(2))[3]:
        pass
    with pytest.raises(UsageError, match="the episode is over"):
        env.step(np.zeros(2))


def test_who_sees_nothing_sees_time():
    """A rhythm needs no observers; its scene is an environment all the same."""
    blind = [
        "observers={}",
        "goals={}",
        "controller={sinusoid: {frequency: 2}}",
        "objective={up: {height: {body: finger, axis: y}}}",
    ]
    env = cqrun.environment(FINGER, [*SMALL, *blind], threads=1)
    first, _ = env.reset(seed=0)
    second = env.step(np.zeros(2))[0]
    assert len(first) == 1
    assert second[0] > first[0]


def test_ppo_learns_on_it(env):
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", env, n_steps=40, batch_size=20, n_epochs=1, device="cpu", seed=0)
    model.learn(80)
    action, _ = model.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(action)


def test_ppo_of_the_figures_learns_the_same_whatever_runs_beside_it(tmp_path):
    """Two in one process shared torch's random numbers; each has a process of its own."""
    files = [tmp_path / str(k) / "curve.csv" for k in range(3)]  # one trainer works in a folder
    for file in files:
        file.parent.mkdir()
    words = [sys.executable, "-m", "benchmarks.papers.families.train_ppo", FINGER, "25"]
    children = [
        subprocess.Popen([*words, seed, str(file), "head", *SMALL, "objective.tip.reach.squared=false"])
        for seed, file in zip("770", files, strict=True)
    ]
    assert [child.wait(timeout=300) for child in children] == [0, 0, 0]
    first, again, other = (file.read_text() for file in files)
    assert first == again != other
    assert first.startswith("head\n")
    assert first.count("\n") == 26

"""Policies in the loop: gradients through whole rollouts, which must not depend on memory, threads or replays."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import reference
from little_worlds import needs_jit
from rich_scene import KINDS, arrays, direction, moved, parts
from robots import TINY, Robot, make_robot

from cqrun.controllers.controller import Controller
from cqrun.controllers.linear_tanh import LinearTanh
from cqrun.controllers.mlp import Mlp
from cqrun.controllers.open_loop import OpenLoop
from cqrun.controllers.sinusoid import Sinusoid
from cqrun.engine.frames import make_rollout
from cqrun.engine.rollout import Rollout
from cqrun.plugin.registry import plugins

pytestmark = needs_jit

DOT_PRODUCT = 1e-9
EXAMPLES: dict[str, Controller] = {
    "linear_tanh": LinearTanh(spread=0.3, gain=0.9),
    "mlp": Mlp(hidden=[6, 5]),
    "mlp_tanh": Mlp(hidden=[4], activation="tanh"),
    "sinusoid": Sinusoid(count=3, frequency=20.0, learn=["phase", "frequency"], spread=0.7),
    "open_loop": OpenLoop(initial=0.5, noise=0.1),
    "open_loop_linear": OpenLoop(initial=0.5, noise=0.1, every=2, interpolate="linear"),
}
CASES = [(name, 2) for name in EXAMPLES] + [("mlp", 3)]
CLOSED_LOOP = {name: controller for name, controller in EXAMPLES.items() if controller.closed_loop}


@pytest.fixture(scope="module", params=CASES, ids=[f"{name}-{dim}D" for name, dim in CASES])
def learner(request) -> tuple[Robot, Rollout, object]:
    """Return a robot with slow actuators, its rollout after the backward run, and the gradient by its inputs."""
    name, dim = request.param
    robot = make_robot(EXAMPLES[name], dim)
    rollout, _, bar = robot.gradient()
    return robot, rollout, bar


def test_every_controller_has_an_example():
    learned = {name for name, controller in plugins("controller").items() if controller.learned}
    assert {controller.name for controller in EXAMPLES.values()} == learned


def test_rollout_agrees_with_the_reference(learner):
    robot, rollout, _ = learner
    inputs = moved(robot.inputs, "x", np.zeros(robot.inputs.state.x.shape))
    records, _, _ = reference.rollout(robot.model, inputs, robot.policy())
    np.testing.assert_allclose(rollout.activation, inputs.activation, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rollout.memory[-1], inputs.state.memory, rtol=0, atol=1e-12)
    for got, want in zip(parts(make_rollout(robot.model, robot.inputs, policy=robot.policy()).run()), parts(records),
                         strict=True):  # fmt: skip
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * np.abs(want).max())
    # some steps are as fast as the rate allows, others are slower
    slow = np.isfinite(robot.limits.change)
    share = np.abs(np.diff(rollout.activation[:, slow], axis=0)) / robot.limits.change[slow]
    assert share.max() == pytest.approx(1.0, abs=1e-12)
    assert (share < 0.999).any()


def test_dot_product_by_parameters(learner, rng):
    """Each block of the controller's parameters, against a complex step through the whole rollout."""
    robot, rollout, _ = learner
    for name, value in robot.parameters.items():
        change = rng.normal(size=value.shape)
        forward = robot.derivative(robot.inputs, robot.parameters | {name: value + 1j * TINY * change})
        backward = (rollout.parameters_bar[name] * change).sum()
        assert abs(forward) > 0, name
        assert backward == pytest.approx(forward, rel=DOT_PRODUCT), name


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.endswith(".activation")])
def test_dot_product_by_inputs(learner, kind, rng):
    """Inputs that move the particles change the observations, and so the activations."""
    robot, _, bar = learner
    change = direction(robot.inputs, kind, rng)
    forward = robot.derivative(moved(robot.inputs, kind, 1j * TINY * change), robot.parameters)
    assert (arrays(bar)[KINDS.index(kind)] * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.parametrize("name", EXAMPLES)
def test_dot_product_without_rates(name, rng):
    """Without rates the memory is that of the observers only."""
    robot = make_robot(EXAMPLES[name], slow=False)
    assert len(robot.policy().memory) == robot.observation.n_memory > 0
    rollout, _, _ = robot.gradient()
    changes = {n: rng.normal(size=a.shape) for n, a in robot.parameters.items()}
    turned = {n: a + 1j * TINY * changes[n] for n, a in robot.parameters.items()}
    backward = sum((rollout.parameters_bar[n] * changes[n]).sum() for n in changes)
    assert backward == pytest.approx(robot.derivative(robot.inputs, turned), rel=DOT_PRODUCT)


def assert_identical(first: tuple, second: tuple) -> None:
    """Check that activations, memory, records and all gradients of two rollouts are bit-for-bit identical."""
    (a, records_a, bar_a), (b, records_b, bar_b) = first, second
    np.testing.assert_array_equal(a.activation, b.activation)
    np.testing.assert_array_equal(a.memory, b.memory)
    for p, q in zip(parts(records_a), parts(records_b), strict=True):
        np.testing.assert_array_equal(p, q)
    for kind, p, q in zip(KINDS, arrays(bar_a), arrays(bar_b), strict=True):
        np.testing.assert_array_equal(p, q, err_msg=kind)
    for name, p in a.parameters_bar.items():
        np.testing.assert_array_equal(p, b.parameters_bar[name], err_msg=name)
    assert a.growth_at == b.growth_at


@pytest.mark.parametrize(("substeps", "controls"), [(3, 20), (11, 6), (8, 8)])
@pytest.mark.parametrize("states", [10, 13, 26])
def test_replay_in_little_memory_gives_identical_results(substeps, controls, states):
    """Chunks of 8 substeps, or a multiple, begin inside control steps, before and after the policy has acted."""
    robot = make_robot(EXAMPLES["mlp"], substeps=substeps, controls=controls)
    everything, little = robot.gradient(), robot.gradient(states=states)
    assert everything[0].plan.n_chunks == 1
    assert little[0].plan.n_chunks > 1
    assert little[0].plan.recompute > 1.0
    assert_identical(little, everything)


def test_policy_is_called_once_per_control_step_in_spite_of_replays():
    robot = make_robot(EXAMPLES["mlp"], substeps=3, controls=20)
    calls: list[tuple[str, int]] = []
    policy = robot.policy()
    act, act_vjp = policy.act, policy.act_vjp
    policy.act = lambda control, *a: (calls.append(("act", control)), act(control, *a))[1]
    policy.act_vjp = lambda control, *a: (calls.append(("vjp", control)), act_vjp(control, *a))[1]
    robot.policy = lambda: policy
    rollout, _, _ = robot.gradient(states=10)
    assert rollout.plan.recompute > 1.5
    assert calls == [("act", k) for k in range(20)] + [("vjp", k) for k in reversed(range(20))]


def count_substeps(rollout: Rollout) -> list[int]:
    """Return a list that grows by the substeps of every advance."""
    counted, advance = [], rollout.advance
    rollout.advance = lambda begin, end, *a, **k: (counted.append(end - begin), advance(begin, end, *a, **k))[1]
    return counted


@pytest.mark.parametrize("states", [None, 13])
def test_several_functions_share_one_forward_run(states):
    """Each backward sweep is bit-for-bit that of a separate gradient, and costs no additional forward substeps."""
    first = make_robot(EXAMPLES["mlp"], substeps=3, controls=20)
    second = replace(
        first, bars={**copy.deepcopy(first.bars), "activation": 2.0 * first.bars["activation"][::-1].copy()}
    )
    both = first.rollout(states=states)
    work = count_substeps(both)
    records, sweeps = both.gradients(lambda records, state: [first.loss_bar, second.loss_bar])
    for robot_alone, sweep in zip((first, second), sweeps, strict=True):
        alone = robot_alone.rollout(states=states)
        work_alone = count_substeps(alone)
        records_alone, bar_alone = alone.gradient(lambda records, state: robot_alone.loss_bar)  # noqa: B023
        assert sum(work) == sum(work_alone) >= 60
        both.parameters_bar, both.growth_at = sweep.parameters_bar, sweep.growth[1]
        assert_identical((both, records, sweep.inputs_bar()), (alone, records_alone, bar_alone))


@pytest.mark.parametrize("name", CLOSED_LOOP)
def test_results_do_not_depend_on_the_number_of_threads(name):
    robot = make_robot(CLOSED_LOOP[name])
    expected = robot.gradient()
    for threads in (2, 3):
        assert_identical(robot.gradient(threads=threads), expected)


def test_forward_run_without_a_gradient_is_identical():
    robot = make_robot(EXAMPLES["mlp"])
    forward = make_rollout(robot.model, robot.inputs, policy=robot.policy())
    records = forward.run()
    rollout, again, _ = robot.gradient()
    np.testing.assert_array_equal(forward.activation, rollout.activation)
    for a, b in zip(parts(records), parts(again), strict=True):
        np.testing.assert_array_equal(a, b)


def test_growth_of_the_gradient_is_located_at_a_control_step():
    rollout, _, _ = make_robot(EXAMPLES["mlp"]).gradient()
    assert 0 <= rollout.growth_at < 6

"""Observers, controller and actuators in the loop: gradients through whole rollouts, and what must not change them."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import reference
from little_worlds import needs_jit
from rich_scene import KINDS, arrays, direction, moved, parts
from robots import TINY, Robot, robot

from cqrun.controllers.controller import Controller
from cqrun.controllers.linear_tanh import LinearTanh
from cqrun.controllers.mlp import Mlp
from cqrun.controllers.open_loop import OpenLoop
from cqrun.controllers.sinusoid import Sinusoid
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
    found = robot(EXAMPLES[name], dim)
    rollout, _, bar = found.gradient()
    return found, rollout, bar


def test_every_controller_has_an_example():
    assert {controller.name for controller in EXAMPLES.values()} == set(plugins("controller"))


def test_the_rollout_is_that_of_the_equations(learner):
    found, rollout, _ = learner
    inputs = moved(found.inputs, "x", np.zeros(found.inputs.state.x.shape))
    records, _, _ = reference.rollout(found.model, inputs, found.policy())
    np.testing.assert_allclose(rollout.activation, inputs.activation, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rollout.memory[-1], inputs.state.memory, rtol=0, atol=1e-12)
    for got, want in zip(parts(Rollout(found.model, found.inputs, policy=found.policy()).run()), parts(records),
                         strict=True):  # fmt: skip
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * np.abs(want).max())
    # the limits are of each kind, and some steps are as fast as an actuator can, others slower
    slow = np.isfinite(found.limits.change)
    share = np.abs(np.diff(rollout.activation[:, slow], axis=0)) / found.limits.change[slow]
    assert share.max() == pytest.approx(1.0, abs=1e-12)
    assert (share < 0.999).any()


def test_dot_product_by_parameters(learner, rng):
    """Each block of the controller's parameters, against a complex step through the whole rollout."""
    found, rollout, _ = learner
    for name, value in found.parameters.items():
        change = rng.normal(size=value.shape)
        forward = found.derivative(found.inputs, found.parameters | {name: value + 1j * TINY * change})
        backward = (rollout.parameters_bar[name] * change).sum()
        assert abs(forward) > 0, name
        assert backward == pytest.approx(forward, rel=DOT_PRODUCT), name


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.endswith(".activation")])
def test_dot_product_by_inputs(learner, kind, rng):
    """What moves the particles moves what is observed of them, and so the activations."""
    found, _, bar = learner
    change = direction(found.inputs, kind, rng)
    forward = found.derivative(moved(found.inputs, kind, 1j * TINY * change), found.parameters)
    assert (arrays(bar)[KINDS.index(kind)] * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.parametrize("name", EXAMPLES)
def test_dot_product_where_nothing_is_slow(name, rng):
    """Without rates the memory is that of the observers alone."""
    found = robot(EXAMPLES[name], slow=False)
    assert len(found.policy().memory) == found.observation.n_memory > 0
    rollout, _, _ = found.gradient()
    changes = {n: rng.normal(size=a.shape) for n, a in found.parameters.items()}
    turned = {n: a + 1j * TINY * changes[n] for n, a in found.parameters.items()}
    backward = sum((rollout.parameters_bar[n] * changes[n]).sum() for n in changes)
    assert backward == pytest.approx(found.derivative(found.inputs, turned), rel=DOT_PRODUCT)


def same_bits(one: tuple, other: tuple) -> None:
    """Compare activations, memory, records, and all gradients of two rollouts, to the bit."""
    (a, records_a, bar_a), (b, records_b, bar_b) = one, other
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
def test_in_little_memory_control_steps_are_cut_and_replayed_to_the_bit(substeps, controls, states):
    """Chunks of 8 substeps or a multiple of it begin inside control steps, decided ones and others."""
    found = robot(EXAMPLES["mlp"], substeps=substeps, controls=controls)
    everything, little = found.gradient(), found.gradient(states=states)
    assert everything[0].plan.n_chunks == 1
    assert little[0].plan.n_chunks > 1
    assert little[0].plan.recompute > 1.0
    same_bits(little, everything)


def test_a_policy_is_asked_once_a_control_step_however_often_it_is_replayed():
    found = robot(EXAMPLES["mlp"], substeps=3, controls=20)
    asked: list[tuple[str, int]] = []
    policy = found.policy()
    act, act_vjp = policy.act, policy.act_vjp
    policy.act = lambda control, *a: (asked.append(("act", control)), act(control, *a))[1]
    policy.act_vjp = lambda control, *a: (asked.append(("vjp", control)), act_vjp(control, *a))[1]
    found.policy = lambda: policy
    rollout, _, _ = found.gradient(states=10)
    assert rollout.plan.recompute > 1.5
    assert asked == [("act", k) for k in range(20)] + [("vjp", k) for k in reversed(range(20))]


def count_substeps(rollout: Rollout) -> list[int]:
    """Return a list that grows by the substeps of every advance."""
    counted, advance = [], rollout.advance
    rollout.advance = lambda begin, end, *a, **k: (counted.append(end - begin), advance(begin, end, *a, **k))[1]
    return counted


@pytest.mark.parametrize("states", [None, 13])
def test_several_functions_share_one_forward_run(states):
    """Each sweep has the bits of a gradient of its own, and no substep is computed once more for it."""
    one = robot(EXAMPLES["mlp"], substeps=3, controls=20)
    other = replace(one, bars={**copy.deepcopy(one.bars), "activation": 2.0 * one.bars["activation"][::-1].copy()})
    both = one.rollout(states=states)
    work = count_substeps(both)
    records, sweeps = both.gradients(lambda records, state: [one.loss_bar, other.loss_bar])
    for robot_alone, sweep in zip((one, other), sweeps, strict=True):
        alone = robot_alone.rollout(states=states)
        own_work = count_substeps(alone)
        own_records, own_bar = alone.gradient(lambda records, state: robot_alone.loss_bar)  # noqa: B023
        assert sum(work) == sum(own_work) >= 60
        both.parameters_bar, both.growth_at = sweep.parameters_bar, sweep.growth[1]
        same_bits((both, records, sweep.inputs_bar()), (alone, own_records, own_bar))


@pytest.mark.parametrize("name", CLOSED_LOOP)
def test_one_thread_and_two_and_three_give_the_same_bits(name):
    found = robot(CLOSED_LOOP[name])
    one = found.gradient()
    for threads in (2, 3):
        same_bits(found.gradient(threads=threads), one)


def test_the_forward_run_decides_as_the_gradients_does():
    found = robot(EXAMPLES["mlp"])
    forward = Rollout(found.model, found.inputs, policy=found.policy())
    records = forward.run()
    rollout, again, _ = found.gradient()
    np.testing.assert_array_equal(forward.activation, rollout.activation)
    for a, b in zip(parts(records), parts(again), strict=True):
        np.testing.assert_array_equal(a, b)


def test_growth_is_blamed_on_a_control_step():
    rollout, _, _ = robot(EXAMPLES["mlp"]).gradient()
    assert 0 <= rollout.growth_at < 6

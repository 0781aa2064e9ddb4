"""Rates from the first control step on: activations of a policy, its adjoint beside the kinks, and signals."""

from __future__ import annotations

import numpy as np
import pytest
from made_matter import made_matter
from small_finger import FINGER

from cqrun.build.model import build
from cqrun.controllers.open_loop import OpenLoop
from cqrun.controllers.policy import ControlPolicy, Limits
from cqrun.engine.policy import Sight
from cqrun.observers.observer import Observation
from cqrun.scene.load import load_scene

STEPS, CHANGE = 6, np.array([0.25, 0.125, np.inf])
LIMITS = Limits(np.array([-1.0, 0.0, 0.0]), np.ones(3), CHANGE, np.array([0.0, 1.0, 0.0]))
"""Limits of a muscle, a cable, which does nothing at 1, and a chamber without a rate."""

NO_OBSERVATIONS = Observation.of({}, made_matter(2))
NOTHING = Sight(np.zeros((12, 0)))
DIFFERENCE = 2.0**-20
"""A power of two, so that sums are exact and kinks are hit exactly."""


def acted(knots: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], ControlPolicy]:
    """Return the activations (T, A) for a table of knots, the memory before each step, and the policy."""
    policy = ControlPolicy(NO_OBSERVATIONS, OpenLoop(), {"knots": knots}, LIMITS, {}, 0.01, 2)
    activation, memory = np.zeros(knots.shape), [policy.memory]
    for control in range(len(knots)):
        activation[control], following = policy.act(control, NOTHING, memory[-1], lambda: None)
        memory.append(following)
    return activation, memory, policy


def gradient(knots: np.ndarray, bar: np.ndarray) -> np.ndarray:
    """Return the cotangent of the knots from that of the activations."""
    _, memory, policy = acted(knots)
    out, memory_bar = policy.parameters_zero(), np.zeros(len(policy.memory))
    for control in reversed(range(len(knots))):
        _, memory_bar, _ = policy.act_vjp(
            control, NOTHING, memory[control], lambda: None, bar[control], memory_bar, out
        )
    return out["knots"]


def test_rate_applies_from_the_first_step_on():
    """The muscle goes from 0 towards 1, the cable from slack towards 0; the chamber has no rate and jumps."""
    activation, _, _ = acted(np.tile([1.0, 0.0, 0.75], (STEPS, 1)))
    np.testing.assert_array_equal(activation[:, 0], [0.25, 0.5, 0.75, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(activation[:, 1], [0.875, 0.75, 0.625, 0.5, 0.375, 0.25])
    np.testing.assert_array_equal(activation[:, 2], 0.75)


def test_gradient_is_zero_where_a_rate_limits_the_activation(rng):
    """The gradient by every knot, some limited by the rate and some not, against finite differences."""
    knots = 0.5 + 0.4 * rng.uniform(-1, 1, (STEPS, 3))
    knots[0] = [0.125, 0.5, 0.25]
    bar = rng.normal(size=knots.shape)
    computed, want = gradient(knots, bar), np.zeros(knots.shape)
    for at in np.ndindex(knots.shape):
        h = np.zeros(knots.shape)
        h[at] = DIFFERENCE
        want[at] = ((acted(knots + h)[0] - acted(knots - h)[0]) * bar).sum() / (2 * DIFFERENCE)
    np.testing.assert_allclose(computed, want, atol=1e-8)
    assert computed[0, 0] != 0.0
    assert computed[0, 1] == 0.0, "the rate limits the cable"


@pytest.mark.parametrize(("actuator", "wanted", "inside"), [(0, 0.25, -1), (0, -0.25, 1), (1, 0.875, 1)])
def test_derivative_exactly_at_the_rate_is_that_of_the_inside(actuator, wanted, inside):
    knots, bar = np.tile(LIMITS.neutral, (1, 1)), np.zeros((1, 3))
    knots[0, actuator], bar[0, actuator] = wanted, 1.0
    h = inside * DIFFERENCE * bar
    inner, outer = ((acted(knots + side * h)[0] - acted(knots)[0])[0, actuator] / DIFFERENCE for side in (1, -1))
    assert (inner * inside, outer) == (1.0, 0.0)
    np.testing.assert_array_equal(gradient(knots, bar), bar)


def test_taylor_remainder_of_a_table_of_knots_is_of_second_order(rng):
    """A nonlinear function of activations limited at first, with steps that stay on one side of every kink."""
    knots, way = 0.5 + 0.4 * rng.uniform(-1, 1, (STEPS, 3)), rng.normal(size=(STEPS, 3))
    activation = acted(knots)[0]
    slope = (gradient(knots, np.cos(3 * activation) * 3) * way).sum()
    steps = 2.0 ** -np.arange(8, 14)
    left = [abs(np.sin(3 * acted(knots + h * way)[0]).sum() - np.sin(3 * activation).sum() - h * slope) for h in steps]
    rates = np.log2(np.array(left[:-1]) / left[1:])
    assert np.all(rates > 1.9), rates


SIGNALS = ["controller=null", "observers={}", "episodes=null", "actuators.muscle.muscle.rate=25"]


def test_rate_applies_to_signals_from_the_first_step_on(rng):
    """A rate of 25/s allows 0.25 in a step of 0.01 s; gradients by the knots agree with finite differences."""
    scene = load_scene(FINGER, [*SIGNALS, "activation={signals: {muscle: [1, -0.25, 0.5]}}"])
    drive = build(scene).assembly.actuation
    activation = drive.activations(0, {})
    np.testing.assert_allclose(activation[:, 0], [0.25, 0.5, 0.75, 0.5, 0.25, 0.0, -0.25, 0.0, 0.25, 0.5])
    gentle = {f"activation.signals.muscle.{k}": np.array(knot) for k, knot in enumerate((0.125, 0.75, 0.375))}
    bar = rng.normal(size=activation.shape)
    out = {path: np.zeros(()) for path in gentle}
    drive.activations_vjp(bar, 0, gentle, out)
    for path, value in gentle.items():
        ends = [drive.activations(0, gentle | {path: value + side * DIFFERENCE}) for side in (1, -1)]
        assert out[path] == pytest.approx(((ends[0] - ends[1]) * bar).sum() / (2 * DIFFERENCE), abs=1e-8), path
    assert out["activation.signals.muscle.0"] != 0.0

"""Values of each controller in known cases, its initial parameters, and errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cqrun.controllers.given import Given
from cqrun.controllers.linear_tanh import LinearTanh
from cqrun.controllers.mlp import Mlp
from cqrun.controllers.open_loop import OpenLoop
from cqrun.controllers.sinusoid import Sinusoid
from cqrun.errors import UsageError

LOW, HIGH = np.array([0.0, -1.0]), np.array([1.0, 1.0])
NO_INPUT = np.zeros(0)


def blocks_of(controller, rng, *, n_in=4, n_controls=7, low=LOW, high=HIGH, neutral=0.0):
    within = np.clip(neutral, low, high)
    return {b.name: b for b in controller.blocks(n_in, len(low), n_controls, low, high, within, rng)}


def acts(controller, knots, controls):
    return [controller.act({"knots": np.array(knots)[:, None]}, NO_INPUT, c, 0.0)[0] for c in controls]


def test_open_loop_has_a_knot_for_each_control_step_within_the_ranges(rng):
    knots = blocks_of(OpenLoop(), rng)["knots"]
    assert knots.initial.shape == (7, 2)
    np.testing.assert_array_equal(knots.lower, np.tile(LOW, (7, 1)))
    np.testing.assert_array_equal(knots.upper, np.tile(HIGH, (7, 1)))
    np.testing.assert_array_equal(knots.initial, 0.0)


@pytest.mark.parametrize(
    ("controller", "n_controls", "said"),
    [
        (Mlp(hidden=[2**62]), 7, "the controller mlp would have 3.23e+19 parameters (the weights of all layers)"),
        (Mlp(hidden=[4000, 4000]), 7, "would have 1.6e+07 parameters"),
        (
            Sinusoid(frequency=1.0, count=2**62),
            7,
            "would have 9.22e+18 parameters (4.61e+18 sinusoids for 2 actuators)",
        ),
        (
            OpenLoop(),
            10**15,
            "would have 2e+15 parameters (1e+15 knots for 2 actuators), more than 10,000,000: make it",
        ),
    ],
)
def test_controllers_with_far_too_many_parameters_are_refused_before_they_are_made(rng, controller, n_controls, said):
    with pytest.raises(UsageError) as info:
        blocks_of(controller, rng, n_controls=n_controls)
    assert said in str(info.value)


def test_open_loop_holds_knots():
    assert acts(OpenLoop(every=3), [1.0, 2.0, 4.0], range(9)) == [1, 1, 1, 2, 2, 2, 4, 4, 4]
    assert acts(OpenLoop(every=3), [1.0, 2.0], [6, 100]) == [2, 2], "a longer replay holds the last knot"


def test_open_loop_interpolates_knots():
    controller = OpenLoop(every=4, interpolate="linear")
    assert acts(controller, [1.0, 2.0, 4.0], [0, 1, 4, 6, 8, 9, 100]) == [1, 1.25, 2, 3, 4, 4, 4]


@pytest.mark.parametrize(
    ("n_controls", "every", "hold", "linear"), [(9, 3, 3, 4), (10, 3, 4, 4), (7, 1, 7, 7), (1, 5, 1, 1)]
)
def test_open_loop_has_no_knot_without_effect(rng, n_controls, every, hold, linear):
    for kind, count in (("hold", hold), ("linear", linear)):
        controller = OpenLoop(every=every, interpolate=kind)
        knots = blocks_of(controller, rng, n_controls=n_controls)["knots"].initial
        assert len(knots) == count, kind
        out = {"knots": np.zeros(knots.shape)}
        for control in range(n_controls):
            controller.act_vjp({"knots": knots}, NO_INPUT, control, 0.0, np.ones(2), out)
        assert (out["knots"] > 0).all(), kind


def test_open_loop_starts_in_range(rng):
    low, high = np.array([0.2, -1.0]), np.array([1.0, -0.5])
    np.testing.assert_array_equal(blocks_of(OpenLoop(), rng, low=low, high=high)["knots"].initial[0], [0.2, -0.5])
    slack = blocks_of(OpenLoop(), rng, neutral=[1.0, 0.0])["knots"].initial
    np.testing.assert_array_equal(slack, np.tile([1.0, 0.0], (7, 1)))
    np.testing.assert_array_equal(blocks_of(OpenLoop(initial=0.3), rng, neutral=[1.0, 0.0])["knots"].initial, 0.3)
    noisy = blocks_of(OpenLoop(initial=0.9, noise=0.5), rng)["knots"].initial
    assert ((noisy >= LOW) & (noisy <= HIGH)).all()
    assert noisy.std() > 0.1
    with pytest.raises(UsageError, match=r"starts at 1.5, which is out of an actuator's range.*0 to 1"):
        blocks_of(OpenLoop(initial=1.5), rng)


@pytest.mark.parametrize(("interpolate", "wanted"), [("hold", [0, 0, 1, 1, 1]), ("linear", [0, 0.5, 1, 1, 1])])
def test_given_plays_its_knots_and_has_no_parameters(rng, interpolate, wanted):
    controller = Given(knots=[[0.0, -1.0], [1.0, 1.0]], every=2, interpolate=interpolate)
    assert blocks_of(controller, rng) == {}
    played = np.array([controller.act({}, NO_INPUT, c, 0.0) for c in (0, 1, 2, 3, 100)])
    np.testing.assert_array_equal(played, np.outer(wanted, [1, 2]) + np.array([0, -1]))


@pytest.mark.parametrize(
    ("knots", "said"),
    [
        ([[0.5]], r"knots.0 has 1 activation, and there are 2 to drive"),
        ([[0, 0], [0.5, 2.0]], r"knots.1 is \[0.5, 2.0\], which is out of an actuator's range"),
    ],
)
def test_given_fits_the_actuators(rng, knots, said):
    with pytest.raises(UsageError, match=said):
        blocks_of(Given(knots=knots), rng)


def test_linear_tanh_is_the_controller_of_cq1(rng):
    blocks = blocks_of(LinearTanh(), rng, n_in=400, low=np.zeros(50), high=np.ones(50))
    assert blocks["weights"].initial.std() == pytest.approx(0.02, rel=0.02)
    assert not blocks["biases"].initial.any()
    W, b, z = rng.normal(size=(2, 4)), rng.normal(size=2), rng.normal(size=4)
    u = LinearTanh(gain=0.5).act({"weights": W, "biases": b}, z, 0, 0.0)
    np.testing.assert_allclose(u, 0.5 * np.tanh(W @ z + b))


def test_sinusoid_is_the_controller_of_cq1s_crawler(rng):
    """a_j = 4 tanh(sum_k W_jk sin(0.06 step + 2 pi k / 8) + b_j), the 4 being the actuators' strength."""
    step, frequency = 5e-3, 0.06 / 5e-3 / (2 * math.pi)
    controller = Sinusoid(frequency=frequency)
    W, b = rng.normal(size=(2, 8)), rng.normal(size=2)
    for control in (0, 1, 57):
        waves = np.sin(0.06 * control + 2 * np.pi * np.arange(8) / 8)
        u = controller.act({"weights": W, "biases": b}, NO_INPUT, control, control * step)
        np.testing.assert_allclose(u, np.tanh(W @ waves + b), rtol=1e-12)
    assert frequency == pytest.approx(1.91, abs=0.005), "the docstring states it"


def test_sinusoid_learns_the_parameters_that_learn_names(rng):
    assert set(blocks_of(Sinusoid(frequency=2.0), rng)) == {"weights", "biases"}
    blocks = blocks_of(Sinusoid(frequency=2.0, learn=["phase", "frequency"]), rng)
    np.testing.assert_allclose(blocks["phase"].initial, 2 * np.pi * np.arange(8) / 8)
    assert blocks["frequency"].initial.tolist() == [2.0]
    assert blocks["frequency"].lower == 0.0
    fixed, learned = Sinusoid(frequency=2.0), Sinusoid(frequency=2.0, learn=["phase", "frequency"])
    parameters = {name: block.initial for name, block in blocks.items()}
    np.testing.assert_array_equal(fixed.act(parameters, NO_INPUT, 0, 0.3), learned.act(parameters, NO_INPUT, 0, 0.3))


def test_mlp_is_the_controller_of_cq2(rng):
    blocks = blocks_of(Mlp(), rng)
    shapes = {name: block.initial.shape for name, block in blocks.items()}
    assert shapes == {"weights0": (64, 4), "biases0": (64,), "weights1": (64, 64), "biases1": (64,),
                      "weights2": (2, 64), "biases2": (2,)}  # fmt: skip
    p = {name: block.initial for name, block in blocks.items()}
    z = rng.normal(size=4)
    hidden = np.maximum(p["weights1"] @ np.maximum(p["weights0"] @ z, 0.0), 0.0)
    np.testing.assert_allclose(Mlp().act(p, z, 0, 0.0), np.tanh(p["weights2"] @ hidden))


@pytest.mark.parametrize(("activation", "variance"), [("relu", 2 / 300), ("tanh", 2 / 500)])
def test_initial_weights_of_the_mlp_have_the_variances_of_he_and_glorot(rng, activation, variance):
    controller = Mlp(hidden=[200], activation=activation, output_spread=0.1)
    blocks = blocks_of(controller, rng, n_in=300, low=np.zeros(100), high=np.ones(100))
    assert blocks["weights0"].initial.var() == pytest.approx(variance, rel=0.05)
    assert blocks["weights1"].initial.var() == pytest.approx(0.01 * 2 / 300, rel=0.05)


@pytest.mark.parametrize("controller", [LinearTanh(), Mlp()], ids=["linear_tanh", "mlp"])
def test_closed_loop_without_observations_is_an_error(controller, rng):
    with pytest.raises(UsageError, match=f"controller {controller.name} acts on observations and there are none"):
        blocks_of(controller, rng, n_in=0)

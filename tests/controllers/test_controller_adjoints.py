"""Every registered controller: its adjoint checked by complex step, on each side of every kink."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_matter import mismatch, moved, slope

from cqrun.controllers.controller import Controller
from cqrun.controllers.mlp import Mlp
from cqrun.plugin.registry import plugins

N_IN, N_OUT, N_CONTROLS, CONTROL_STEP = 5, 3, 8, 0.05
LOW, HIGH = np.array([0.0, -1.0, -2.0]), np.array([1.0, 1.0, 0.5])

EXAMPLES: dict[str, list[dict[str, Any]]] = {
    "open_loop": [{}, {"every": 3, "noise": 0.5}, {"every": 3, "interpolate": "linear", "initial": 0.2, "noise": 0.1}],
    "given": [{"knots": [[0.2, -0.5, 0.1], [1.0, 1.0, 0.5]], "every": 3, "interpolate": "linear"}],
    "linear_tanh": [{}, {"gain": 0.7, "spread": 0.5}],
    "sinusoid": [
        {"frequency": 2.0, "spread": 0.4},
        {"frequency": 1.5, "count": 3, "learn": ["phase", "frequency"], "gain": 0.6, "spread": 0.4},
        {"frequency": 1.5, "count": 3, "learn": ["frequency"], "spread": 0.4},
    ],
    "mlp": [{"hidden": [7, 6]}, {"hidden": [6], "activation": "tanh", "output_spread": 0.3}, {"hidden": []}],
}
CASES = [(name, k) for name, tried in EXAMPLES.items() for k in range(len(tried))]
EVERY = pytest.mark.parametrize(("name", "k"), CASES, ids=[f"{name}{k}" for name, k in CASES])


def make(name: str, k: int) -> Controller:
    spec: Controller = plugins("controller")[name].model_validate(EXAMPLES[name][k])
    return spec


def initial_parameters(controller: Controller, rng: np.random.Generator) -> dict[str, np.ndarray]:
    blocks = controller.blocks(N_IN, N_OUT, N_CONTROLS, LOW, HIGH, np.zeros(N_OUT), rng)
    return {block.name: block.initial for block in blocks}


def adjoint_errors(controller: Controller, control: int, rng: np.random.Generator) -> dict[str, float]:
    """Return the relative error of the dot product for each block, and for the observations."""
    parameters, z = initial_parameters(controller, rng), rng.normal(size=N_IN)
    parameters = {name: a + 0.1 * rng.normal(size=a.shape) for name, a in parameters.items()}
    time, u_bar = control * CONTROL_STEP, rng.normal(size=N_OUT)
    before = {name: rng.normal(size=a.shape) for name, a in parameters.items()}
    out = {name: a.copy() for name, a in before.items()}
    bars = {"z": controller.act_vjp(parameters, z, control, time, u_bar, out)}
    bars |= {name: out[name] - before[name] for name in out}  # they were added to `before`
    errors = {}
    for name, bar in bars.items():
        direction = rng.normal(size=bar.shape)
        tilted_z = moved(z, direction) if name == "z" else z
        tilted = {n: moved(a, direction) if n == name else a for n, a in parameters.items()}
        expected = slope(lambda p=tilted, q=tilted_z: controller.act(p, q, control, time), u_bar)
        errors[name] = mismatch(float(np.sum(bar * direction)), expected, float(np.abs(bar * direction).sum()))
    return errors


def test_every_controller_has_an_example():
    assert set(EXAMPLES) == set(plugins("controller"))


@EVERY
@pytest.mark.parametrize("control", [0, 4, N_CONTROLS - 1, N_CONTROLS + 5])
def test_dot_product(name, k, control, rng):
    for argument, error in adjoint_errors(make(name, k), control, rng).items():
        assert error <= 1e-9, argument


@EVERY
def test_blocks_bounds_and_class_attributes_are_right(name, k, rng):
    controller = make(name, k)
    blocks = controller.blocks(N_IN, N_OUT, N_CONTROLS, LOW, HIGH, np.zeros(N_OUT), rng)
    parameters = {block.name: block.initial for block in blocks}
    assert len(parameters) == len(blocks)
    for block in blocks:
        assert np.shape(block.lower) in ((), block.initial.shape)
        assert np.all(block.lower <= block.initial)
        assert np.all(block.initial <= block.upper)
    for control in range(N_CONTROLS):
        u = controller.act(parameters, 5 * rng.normal(size=N_IN), control, control * CONTROL_STEP)
        assert u.shape == (N_OUT,)
        low, high = (-1.0, 1.0) if controller.bounded else (LOW, HIGH)
        assert np.all((low <= u) & (u <= high))
    first, second = (controller.act(parameters, z, 2, 0.1) for z in (np.zeros(N_IN), np.ones(N_IN)))
    assert controller.closed_loop == bool(np.any(first != second))


@EVERY
def test_same_seed_gives_the_same_initial_parameters(name, k):
    first, second = (initial_parameters(make(name, k), np.random.default_rng(7)) for _ in range(2))
    assert all(np.array_equal(first[block], second[block]) for block in first)


def test_a_wrong_adjoint_fails(rng):
    class Wrong(Mlp):
        def act_vjp(self, parameters, z, control, time, u_bar, out):
            return 1.001 * super().act_vjp(parameters, z, control, time, u_bar, out)

    errors = adjoint_errors(Wrong(hidden=[4]), 0, rng)
    assert errors.pop("z") > 1e-4
    assert max(errors.values()) <= 1e-9


def test_relu_on_both_sides_and_at_its_kink(rng):
    """Hidden unit 0 is off, 1 is on, 2 is at the kink, where the derivative is taken as 0."""
    controller = Mlp(hidden=[3])
    parameters = initial_parameters(controller, rng) | {"biases0": np.array([-20.0, 20.0, 0.0])}
    parameters["weights0"][2] = 0.0
    z, u_bar = rng.normal(size=N_IN), rng.normal(size=N_OUT)
    out = {name: np.zeros(a.shape) for name, a in parameters.items()}
    controller.act_vjp(parameters, z, 0, 0.0, u_bar, out)
    assert out["biases0"][0] == 0.0
    assert out["biases0"][1] != 0.0
    assert out["biases0"][2] == 0.0

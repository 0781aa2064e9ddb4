"""Policies that see rigid bodies, reactions, tensions and pressures: gradients through whole rollouts."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import total_lagrangian
from little_worlds import needs_jit
from rich_scene import ACTUATORS, KINDS, arrays, direction, make_complex, moved, product
from robots import GOALS, limits_of, matter_of
from scipy import sparse
from test_reference_frame import DOT_PRODUCT, TINY
from test_rigid_bodies import (
    RIGID,
    all_of,
    carried,
    compiled,
    completed,
    direction_of,
    gripped,
    moved_rigid,
    random_bar,
)

from cqrun.actuators.cable import Cable
from cqrun.controllers.linear_tanh import LinearTanh
from cqrun.controllers.policy import ControlPolicy
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar
from cqrun.observers.centroids import Centroids
from cqrun.observers.matter import Route
from cqrun.observers.measured import Measured
from cqrun.observers.observer import Observation
from cqrun.plugin.registry import plugins

SEEN: dict[str, Any] = {
    "place": {"rigid_motion": {"rigid": "stone"}},
    "turn": {"rigid_motion": {"rigid": "stone", "of": "rotation"}},
    "spin": {"rigid_motion": {"rigid": "wheel", "of": "spin"}},
    "slip": {"rigid_motion": {"rigid": "stone", "of": "velocity", "relative_to": "jaw"}},
    "turned": {"rigid_motion": {"rigid": "jaw", "of": "rotation"}},
    "grip": {"reaction": {"boundary": "stone"}},
    "twist": {"reaction": {"boundary": "stone", "of": "moment", "on": "boundary"}},
    "pushed": {"reaction": {"boundary": "jaw"}},
    "held": {"reaction": {"boundary": "sticky"}},
    "pull": {"cable_tension": {"cable": "cable"}},
}
POSES, FORCES = ("place", "turn", "spin", "slip", "turned"), ("grip", "twist", "pushed", "held", "pull")
CABLE = ACTUATORS["cable"].start
CONTROLS = 4


class Gripper:
    """A rich model with rigid bodies, and a controller that sees some of them.

    Args:
        scene: the model and its inputs.
        names: of what it sees, in `SEEN`.
    """

    def __init__(self, scene: tuple[Any, Any], names: tuple[str, ...], *, viscous: bool = True) -> None:
        (model, self.inputs), self.viscous, rng = scene, viscous, np.random.default_rng(3)
        if "held" in names:
            model = replace(model, reactions=(*model.reactions, "sticky"))
        measures = {
            name: plugins("measure")[kind](**fields) for name in names for kind, fields in SEEN[name].items()
        }  # fmt: skip
        law = Cable(body="second", route=[[0.0] * model.dim, [1.0] * model.dim], stiffness=1.0)
        route = Route(model.actuators[CABLE].particles, CABLE, law, activated=True)
        matter = replace(matter_of(model, self.inputs), measures=measures, routes={"cable": route})
        bound = {name: Measured(quantity=name, range=SIZES.get(name, "auto")).bind(matter) for name in names}
        bound["parts"] = Centroids(body="second", of=["velocity"]).bind(matter)
        self.observation = Observation(bound, matter.n_particles)
        rows = sparse.vstack([self.observation.rows, model.probe]).tocsr()
        self.model = replace(model, probe=sparse.csr_array(rows))
        self.limits, self.controller = limits_of(slow=True), LinearTanh(spread=0.4, gain=0.9)
        blocks = self.controller.blocks(
            self.observation.size, 11, CONTROLS, self.limits.low, self.limits.high, self.limits.neutral, rng
        )
        self.parameters = {block.name: block.initial.copy() for block in blocks}
        self.inputs.state.memory = self.policy().memory
        self.records_bar, self.state_bar = self._bars(np.random.default_rng(7))
        self.activation_bar = rng.normal(size=(CONTROLS, 11))

    def _bars(self, rng: np.random.Generator) -> tuple[Any, Any]:
        records_bar, state_bar = random_bar(self.model, self.inputs, rng)
        more, k = self.observation.rows.shape[0], self.model.probe.shape[0]
        pad = {name: np.zeros((CONTROLS + 1, k, *getattr(records_bar, name).shape[2:])) for name in "xvCF"}
        for name, bar in pad.items():
            bar[:, more:] = getattr(records_bar, name)
        history = {}
        for name, bar in records_bar.history.items():
            history[name] = np.zeros((CONTROLS + 1, k, *bar.shape[2:]))
            history[name][:, more:] = bar
        return replace(records_bar, **pad, history=history), state_bar

    def policy(self, parameters: Any = None) -> ControlPolicy:
        goals = {name: value[: self.model.dim] for name, value in GOALS.items()}
        step, chosen = self.model.substeps * self.model.dt, self.parameters if parameters is None else parameters
        return ControlPolicy(self.observation, self.controller, chosen, self.limits, goals, step, self.model.dim)

    def gradient(self, *, threads: int = 1, budget: int = 2**30, reversible: bool | None = None) -> tuple[Any, Any]:
        """Return the rollout after its backward run, and the gradient by the inputs."""
        model, inputs = compiled(self.model, self.inputs, self.viscous)
        model = replace(model, memory_budget=budget, spare=[])
        rollout = make_rollout(model, inputs, adjoint=True, threads=threads, policy=self.policy())
        if reversible is not None:
            assert rollout.reversible
            rollout.reversible = reversible
        _, bar = rollout.gradient(lambda records, state: LossBar(self.records_bar, self.state_bar, self.activation_bar))
        return rollout, completed(bar, self.viscous)

    def derivative(self, inputs: Any, parameters: Any = None) -> float:
        """Return the derivative along the imaginary parts of inputs or parameters, by the equations in NumPy."""
        turned = copy.deepcopy(inputs)
        make_complex(turned)
        turned.rigid, turned.waypoints = turned.rigid.astype(complex), turned.waypoints.astype(complex)
        records, last = total_lagrangian.rollout(self.model, turned, policy=self.policy(parameters))
        total = all_of(records, self.records_bar) + product(last, self.state_bar)
        total += (turned.state.memory * self.state_bar.memory).sum()
        return float((total + (turned.activation * self.activation_bar).sum()).imag / TINY)


SIZES: dict[str, Any] = {"grip": [-0.1, 0.1], "twist": None, "pushed": [-0.1, 0.1], "held": [-0.1, 0.1]}
"""Ranges of what would not change the activations otherwise."""


@pytest.fixture(scope="module", params=[
    pytest.param((2, True, POSES), id="2D-motion", marks=pytest.mark.slow),
    pytest.param((2, False, FORCES), id="2D-forces", marks=pytest.mark.slow),
    pytest.param((3, False, POSES + FORCES), id="3D-both", marks=pytest.mark.slow),
])  # fmt: skip
def case(request):
    """Return a gripper, its rollout and its gradient."""
    dim, viscous, names = request.param
    scene = gripped(dim, viscous=viscous, seed={2: 0, 3: 9}[dim], controls=CONTROLS)
    gripper = Gripper(scene, names, viscous=viscous)
    return gripper, *gripper.gradient()


def test_the_policy_decides_what_the_equations_say(case):
    gripper, rollout, _ = case
    inputs = copy.deepcopy(gripper.inputs)
    make_complex(inputs)
    policy = gripper.policy()
    total_lagrangian.rollout(gripper.model, inputs, policy=policy)
    np.testing.assert_allclose(rollout.activation, inputs.activation.real, rtol=0, atol=1e-10)
    for seen, known in zip(rollout.policy.observations, policy.observations, strict=True):
        np.testing.assert_allclose(seen, known.real, rtol=0, atol=1e-9 * np.abs(seen).max())


def test_a_reaction_is_that_of_the_control_step_before(case):
    gripper, rollout, _ = case
    records = rollout.read_records()
    for name in gripper.observation.parts:
        if "reaction" in SEEN.get(name, {}):
            place = gripper.observation.parts[name]
            seen = np.array(rollout.policy.observations)[:, place]
            half = gripper.observation.half[place]
            (fields,) = SEEN[name].values()
            dim = gripper.model.dim
            columns = slice(dim, None) if fields.get("of") == "moment" else slice(0, dim)
            sign = -1.0 if fields.get("on") == "boundary" else 1.0
            np.testing.assert_array_equal(seen[0], 0.0)
            np.testing.assert_allclose(
                seen[1:] * half, sign * records.held[fields["boundary"]][1:-1, columns], rtol=1e-12
            )
            assert np.abs(seen[1:]).max() > 1e-3, name


def test_dot_product_by_parameters(case, rng):
    gripper, rollout, _ = case
    for name, value in gripper.parameters.items():
        change = rng.normal(size=value.shape)
        forward = gripper.derivative(gripper.inputs, gripper.parameters | {name: value + 1j * TINY * change})
        assert abs(forward) > 0
        assert (rollout.parameters_bar[name] * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT), name


@pytest.mark.parametrize("name", ["velocity", "mass", "friction", "waypoints"])
def test_dot_product_by_rigid_bodies(case, name, rng):
    gripper, _, bar = case
    change = direction_of(gripper.inputs, name, gripper.model.dim, rng)
    forward = gripper.derivative(moved_rigid(gripper.inputs, name, 1j * TINY * change))
    backward = ((bar.waypoints if name == "waypoints" else bar.rigid[:, RIGID[name]]) * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.parametrize("kind", ["v", "fixed_corotated.E", "cable.strength"])
def test_dot_product_by_soft_bodies(case, kind, rng):
    gripper, _, bar = case
    change = direction(gripper.inputs, kind, rng)
    forward = gripper.derivative(moved(gripper.inputs, kind, 1j * TINY * change))
    assert abs(forward) > 0
    assert (arrays(bar)[KINDS.index(kind)] * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT)


def all_gradients(rollout: Any, bar: Any) -> list[np.ndarray]:
    return [*arrays(bar), bar.rigid, bar.waypoints, *rollout.parameters_bar.values()]


def test_chunks_that_begin_inside_control_steps_give_the_same_gradient():
    """A repeated part of a control step does not know its reactions; those of the first run stay."""
    model, inputs = gripped(2, viscous=False, substeps=20, controls=CONTROLS)
    gripper = Gripper((replace(model, dt=model.dt / 5), inputs), POSES + FORCES, viscous=False)
    everything, bar = gripper.gradient()
    little, other = gripper.gradient(budget=20 * everything.start.nbytes)
    assert everything.plan.n_chunks == 1
    assert little.plan.n_chunks > 1
    assert little.plan.chunk % 20 != 0
    np.testing.assert_array_equal(little.activation, everything.activation)
    for got, want in zip(all_gradients(little, other), all_gradients(everything, bar), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * np.abs(want).max())


@pytest.mark.slow
def test_a_reversed_run_gives_the_gradient_of_kept_states():
    gripper = Gripper(carried(2, controls=CONTROLS), ("turned", "pushed"), viscous=False)
    found = [gripper.gradient(reversible=reversible) for reversible in (True, False)]
    assert found[0][0].plan.backwards
    for got, want in zip(*(all_gradients(*each) for each in found), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max(initial=1e-30))


@needs_jit
def test_any_number_of_threads_gives_the_same_bits():
    found = []
    for threads in (1, 2, 3):
        gripper = Gripper(gripped(2, controls=CONTROLS), POSES + FORCES)
        rollout, bar = gripper.gradient(threads=threads)
        assert rollout.threads == threads
        found.append([a.tobytes() for a in (rollout.activation, *all_gradients(rollout, bar))])
    assert found[0] == found[1] == found[2]

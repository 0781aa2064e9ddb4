"""Taylor remainders through controller, observers, actuators and contact: a block that shuffles over a floor.

Measured: the rate is 2.00 over 20, 50, 100 and 200 control steps on the floor (2,000 substeps, 4 s), for changes of the
weights up to 1.5e-5. Below that, every node and cable takes the same branches as without the change in every substep.
On hills of particles this holds for 30 control steps with a change of 3e-5, and for 59 with 1e-7.
"""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reference
from little_worlds import Acting, Wall, below, needs_jit, world
from scipy import sparse

from cqrun.actuators.cable import Cable
from cqrun.actuators.muscle import Muscle
from cqrun.actuators.pneumatic import Pneumatic
from cqrun.boundaries.friction import Friction
from cqrun.controllers.linear_tanh import LinearTanh
from cqrun.controllers.policy import ControlPolicy, Limits
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Model, Records
from cqrun.observers.centroids import Centroids
from cqrun.observers.clock import Clock
from cqrun.observers.matter import Matter
from cqrun.observers.observer import Observation

SUBSTEPS, DT, DX = 10, 2e-3, 0.1
STEPS = 2.0 ** -np.arange(6, 22)


def lattice(wide: int, high: int, left: float, bottom: float) -> np.ndarray:
    """Return wide x high points 0.05 m apart, the lower left corner of their cells at (left, bottom)."""
    axes = left + 0.05 * (np.arange(wide) + 0.5), bottom + 0.05 * (np.arange(high) + 0.5)
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)


class Shuffler:
    """A block of 8 x 4 particles on a floor with friction: two muscles, a chamber and a cable; its halves are observed.

    With terrain there is a second body above the floor: soft hills of particles.
    """

    def __init__(self, controls: int, *, terrain: bool) -> None:
        rng = np.random.default_rng(5)
        self.bodies = [lattice(8, 4, 0.5, 0.3 if terrain else 0.2)]
        if terrain:
            hills = lattice(24, 2, 0.1, 0.2)
            hills[:, 1] += 0.15 * (hills[:, 1] - 0.2) * np.sin(12 * hills[:, 0])
            self.bodies.append(hills)
        self.x = np.concatenate(self.bodies)
        block = self.x[:32]
        left, right = np.flatnonzero(block[:, 0] < 0.7), np.flatnonzero(block[:, 0] > 0.7)
        route = self.x[[3, 31]].tolist()
        specs: list[tuple[Any, np.ndarray]] = [
            (Muscle(body="b", axis=[0, 1], strength=6.0), left), (Muscle(body="b", axis=[1, 0], strength=6.0), right),
            (Pneumatic(body="b", max_pressure=4.0), right), (Cable(body="b", route=route, stiffness=4.0), [3, 31]),
        ]  # fmt: skip
        self.model, self.inputs = self.built(specs, controls)
        matter = Matter(
            self.x, self.inputs.fields.mass, self.model.size, SUBSTEPS * DT, controls, {"b": slice(0, 32)},
            {"b": {"left": left, "right": right}}, lambda body, region: np.arange(32), {}, 6,
        )  # fmt: skip
        observers = Centroids(body="b", of=["position", "velocity", "acceleration"]), Clock(period=0.3)
        bound = {"parts": observers[0].bind(matter), "clock": observers[1].bind(matter)}
        self.observation = Observation(bound, len(self.x))
        self.model = self.with_probe(self.model)
        low, change = np.array([-1.0, -1.0, 0.0, 0.0, -1.0, 0.0]), np.array([0.15, np.inf, np.inf, 0.2, np.inf, np.inf])
        self.limits = Limits(low, np.ones(6), change, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
        self.controller = LinearTanh(spread=0.3)
        self.parameters = {
            b.name: b.initial for b in self.controller.blocks(self.observation.size, 6, controls, low, low, low, rng)
        }
        self.inputs.state.memory = self.policy(self.parameters).memory
        self.direction = {name: rng.normal(size=value.shape) for name, value in self.parameters.items()}

    def built(self, specs: list[tuple[Any, np.ndarray]], controls: int) -> tuple[Model, Inputs]:
        model, inputs = world(
            self.bodies, size=[2.0, 1.0], dx=DX, dt=DT, substeps=SUBSTEPS, controls=controls, mass=0.05**2,
            volume=0.05**2, E=20.0, eta=0.02, gravity=[0.0, -2.0],
            walls=[Wall(Friction, (0.0, 1.0), below(1, 0.2), 0.5)],
            actuators=tuple(Acting.of(spec, members, self.x) for spec, members in specs),
        )  # fmt: skip
        inputs.strength[:4] = [getattr(spec, spec.scale) for spec, _ in specs]
        return model, inputs

    def with_probe(self, model: Model) -> Model:
        mean = sparse.csr_array(np.where(np.arange(len(self.x)) < 32, 1 / 32, 0.0)[None])
        return replace(model, probe=sparse.csr_array(sparse.vstack([self.observation.rows, mean]).tocsr()))

    def policy(self, parameters: dict[str, np.ndarray]) -> ControlPolicy:
        return ControlPolicy(self.observation, self.controller, parameters, self.limits, {}, SUBSTEPS * DT, 2)

    def moved(self, h: float) -> dict[str, np.ndarray]:
        return {name: value + h * self.direction[name] for name, value in self.parameters.items()}

    def loss(self, h: float) -> float:
        """Return the loss after a change of the parameters by h along the direction."""
        rollout = make_rollout(self.model, self.inputs, policy=self.policy(self.moved(h)))
        return value(rollout.run(), rollout.activation)

    def slope(self) -> float:
        policy = self.policy(self.parameters)
        rollout = make_rollout(self.model, self.inputs, adjoint=True, policy=policy)
        rollout.gradient(lambda records, state: value_bar(records, rollout.activation))
        return float(sum((rollout.parameters_bar[name] * self.direction[name]).sum() for name in self.direction))

    def touches_hills(self) -> bool:
        """Return whether the block and the hills share grid nodes at the end, which is their contact."""
        inputs = copy.deepcopy(self.inputs)
        _, last, _ = reference.rollout(self.model, inputs, self.policy(self.parameters))
        base = np.floor(last.x.real / DX - 0.5).astype(int)
        nodes = base[:, None] + np.stack(np.meshgrid(*[np.arange(3)] * 2, indexing="ij"), -1).reshape(-1, 2)
        block, hills = ({tuple(node) for node in part.reshape(-1, 2).tolist()} for part in (nodes[:32], nodes[32:]))
        return not block.isdisjoint(hills)

    def branches(self, h: float) -> tuple[list[str], np.ndarray]:
        """Return the branches of contact and cables by control step, and which actuators their rate limited."""
        inputs = copy.deepcopy(self.inputs)
        _, _, taken = reference.rollout(self.model, inputs, self.policy(self.moved(h)))
        change = np.diff(inputs.activation, axis=0, prepend=self.limits.neutral[None])
        limited = np.sign(change) * (np.abs(change) > self.limits.change - 1e-12)
        return [str(taken[k * SUBSTEPS : (k + 1) * SUBSTEPS]) + str(limited[k]) for k in range(len(limited))], limited


def value(records: Records, activation: np.ndarray) -> float:
    """Return the loss: distance, speed and effort of the block."""
    x, v = records.x[-1, -1], records.v[-1, -1]
    return float(np.sin(5 * x).sum() + v @ v + 1e-3 * (activation**2).sum())


def value_bar(records: Records, activation: np.ndarray) -> LossBar:
    """Return the cotangents of the loss."""
    bar = Records(*(np.zeros_like(a) for a in (records.x, records.v, records.C, records.F)))
    bar.x[-1, -1], bar.v[-1, -1] = 5 * np.cos(5 * records.x[-1, -1]), 2 * records.v[-1, -1]
    return LossBar(bar, activation=2e-3 * activation)


def taylor_rate(controls: int, *, terrain: bool) -> tuple[float, float]:
    """Return the rate of the Taylor remainder, for changes h that leave all branches the same, and the last h."""
    robot = Shuffler(controls, terrain=terrain)
    here, slope, (taken, limited) = robot.loss(0.0), robot.slope(), robot.branches(0.0)
    kinds = str(taken)
    for branch in (0, 1, 2):
        assert re.search(rf"'friction', 0, \d+, {branch}\)", kinds), f"no node slid in branch {branch}"
    assert re.search(r"'cable', '[^']*', (np\.)?True", kinds), "the cable never pulled"
    if terrain:
        assert robot.touches_hills(), "the block has left its hills"
    assert set(np.unique(np.abs(limited))) == {0.0, 1.0}
    assert limited[0].any(), "no actuator is limited by its rate at the first step"
    remainders: list[float] = []
    for h in STEPS:
        if robot.branches(h)[0] == taken:
            remainders.append(abs(robot.loss(h) - here - h * slope))
        else:
            remainders.clear()
        if len(remainders) == 4:
            return float(np.log2(remainders[0] / remainders[-1]) / 3), float(h)
    raise AssertionError("no four changes in a row leave all branches the same")


@needs_jit
@pytest.mark.parametrize(
    ("terrain", "controls"),
    [(False, 20), (True, 10), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((False, 200), (True, 30)))],
)
def test_taylor_remainder_is_of_second_order(terrain, controls):
    rate, _ = taylor_rate(controls, terrain=terrain)
    assert rate >= 1.9

"""CQ1, Table III: how exact gradients are after 1, 10, 100 and 1,000 substeps, in the paper's own setups.

A1: a ball of 3,375 particles flies freely (3D); A2: it bounces off a wall without friction. The derivative of its mean
final position by its mean initial velocity is the time that has passed. B: one disc of 200 particles hits another
(2D), then both hit walls with friction; truth is a complex step through the equations in plain NumPy. C: the finger of
Fig 7, 4,800 particles, by the weights of its controller; truth as for B.

Measured, float64: A1 3.4e-14, 2.4e-14, 5.7e-14, 6e-15; A2 the same; B (0, 0,) 9e-14, 1.6e-10; C 4e-15, 3e-14, 6e-14,
1.6e-13. The paper's numeric check of B and C, central differences, is run too. B: at 100 substeps a step of 1e-5 m/s
leaves 1e-8 (1e-3, which the published script names, leaves 5e-4 here: the truncation of the differences). C: a step of
1e-4 in weights whose deviation is .02 leaves 1e-7, 2e-8, 4e-9, 1.1e-6.
"""

from __future__ import annotations

import copy
import random
from dataclasses import replace

import numpy as np
import pytest
import reference
from bodies import final, lattice
from little_worlds import Wall, above, below, needs_jit, world
from rich_scene import make_complex
from scipy import sparse

from cqrun.boundaries.friction import Friction
from cqrun.boundaries.sticky import Sticky
from cqrun.controllers.linear_tanh import LinearTanh
from cqrun.controllers.policy import ControlPolicy, Limits
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Model, Records
from cqrun.observers.centroids import Centroids
from cqrun.observers.goal import Goal
from cqrun.observers.matter import Matter
from cqrun.observers.observer import Observation
from cqrun.state import State

pytestmark = needs_jit

PAPER_A1 = {1: 9.80e-8, 10: 4.74e-8, 100: 1.15e-7, 1000: 1.43e-5}
PAPER_A2 = {1000: 2.69e-5}
PAPER_B = {100: 2.39e-8, 1000: 2.83e-8}
PAPER_C = {1: 5.63e-6, 10: 2.24e-7, 100: 6.97e-7, 1000: 1.76e-6}
EXACT = 1e-12
"""What float64 has to reach where the truth is a number on paper."""

DT_A, DT_B = 1e-4, 5e-3
STEP_C = 3e-5
"""Of the controller's weights: its truncation is small at 1,000 substeps, and round-off at one."""

GOAL = np.array([0.7, 0.3])


def ball(dim: int, count: int, centre: list[float], draw: random.Random) -> tuple[np.ndarray, np.ndarray]:
    """Return particles of a ball of radius 1/30 m, uniform by rejection, and their spin (clockwise, 15 rad/s)."""
    found: list[list[float]] = []
    while len(found) < count:
        point = [draw.random() for _ in range(dim)]
        if sum((a - 0.5) ** 2 for a in point) <= 0.25:
            found.append(point)
    u = np.array(found) - 0.5
    spin = np.zeros_like(u)
    spin[:, 0], spin[:, 1] = u[:, 1], -u[:, 0]
    return u / 15 + centre, spin


def flying_ball(steps: int, *, bounces: bool, real: type = np.float64) -> tuple[Model, Inputs]:
    """Return A1, or A2 with its stiffer ball and its wall."""
    x, spin = ball(3, 3375, [0.2, 0.4, 0.4], random.Random(123))
    wall = Wall(Friction, (0, 1, 0), below(1, 0.02), 0.0)
    model, inputs = world(
        x, size=[1.0] * 3, dx=0.01, dt=DT_A, substeps=steps, controls=1, E=100.0 if bounces else 1.0, nu=0.3,
        walls=[wall], real=real, budget=2**28,
    )  # fmt: skip
    inputs.state.v[:] = spin + ([3.0, -6.0, 0.0] if bounces else [0.4, 0.0, 0.0])
    return model, inputs


def gradient_of_mean(model: Model, inputs: Inputs) -> tuple[np.ndarray, State]:
    """Return the gradient of the mean final x-position by the mean initial velocity, and the last state."""
    seen: list[State] = []

    def loss_bar(records: object, last: State) -> LossBar:
        seen.append(last)
        bar = State(*(np.zeros_like(a) for a in (last.x, last.v, last.C, last.F)))
        bar.x[:, 0] = 1.0 / len(last.x)
        return LossBar(final=bar)

    _, bar = make_rollout(model, inputs, adjoint=True).gradient(loss_bar)
    # a shift of all particles shifts the mean by as much
    np.testing.assert_allclose(bar.state.x.sum(0), [1.0, 0.0, 0.0], atol=EXACT if model.real is np.float64 else 1e-5)
    return bar.state.v.sum(0), seen[0]


def relative_error(gradient: np.ndarray, steps: int) -> float:
    """Return how far a gradient is from steps * dt along x."""
    truth = np.array([steps * DT_A, 0.0, 0.0])
    return float(np.linalg.norm(gradient - truth) / truth[0])


@pytest.mark.parametrize("steps", PAPER_A1)
def test_a1_free_flight(steps):
    gradient, _ = gradient_of_mean(*flying_ball(steps, bounces=False))
    assert relative_error(gradient, steps) <= min(EXACT, PAPER_A1[steps])


@pytest.mark.parametrize("steps", PAPER_A1)
def test_a2_a_wall_without_friction(steps):
    """Only the last column has the bounce, and only that is in the paper."""
    gradient, last = gradient_of_mean(*flying_ball(steps, bounces=True))
    assert (last.v[:, 1].mean() > 4.0) == (steps == 1000)
    assert relative_error(gradient, steps) <= min(EXACT, PAPER_A2.get(steps, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("steps", PAPER_A1)
@pytest.mark.parametrize("bounces", [False, True])
def test_a_in_float32(steps, bounces):
    """The paper's own precision: 3e-8, 2e-8, 2e-7, 3e-6 measured; the paper's are 1e-7, 5e-8, 1e-7, 1.4e-5."""
    gradient, _ = gradient_of_mean(*flying_ball(steps, bounces=bounces, real=np.float32))
    assert relative_error(gradient, steps) <= 3 * PAPER_A1[steps]


def billiards(steps: int, v: np.ndarray, real: type = np.float64) -> tuple[Model, Inputs]:
    """Return B: disc A spins, and flies with mean velocity v at disc B, between walls of friction .5."""
    draw = random.Random(100)
    a, spin = ball(2, 200, [4 / 30, 13.75 / 30], draw)
    b, _ = ball(2, 200, [11 / 30, 13.75 / 30], draw)
    walls = [
        Wall(Friction, (1, 0), below(0, 0.02), 0.5), Wall(Friction, (-1, 0), above(0, 0.96), 0.5),
        Wall(Friction, (0, 1), below(1, 0.02), 0.5), Wall(Friction, (0, -1), above(1, 0.96), 0.5),
    ]  # fmt: skip
    model, inputs = world(
        [a, b], size=[1.0, 1.0], dx=0.01, dt=DT_B, substeps=steps, controls=1, E=1.0, nu=0.3, walls=walls,
        real=real,
    )  # fmt: skip
    inputs.state.v[:200] = spin + v
    return model, inputs


V = np.array([0.4, 0.05])


def miss(last: State) -> np.ndarray:
    """Return how far disc B's centre is from the goal."""
    return last.x[200:].mean(0) - GOAL


def gradient_of_billiards(steps: int, real: type = np.float64) -> np.ndarray:
    """Return the gradient of |centre of B - goal|^2 by the velocity of A."""

    def loss_bar(records: object, last: State) -> LossBar:
        bar = State(*(np.zeros_like(a) for a in (last.x, last.v, last.C, last.F)))
        bar.x[200:] = 2 * miss(last) / 200
        return LossBar(final=bar)

    _, bar = make_rollout(*billiards(steps, V, real), adjoint=True).gradient(loss_bar)
    return bar.state.v[:200].sum(0)


@pytest.mark.parametrize("steps", [1, 10])
def test_b_before_the_discs_meet(steps):
    """The gradient is zero, exactly: nothing of disc A has reached disc B."""
    np.testing.assert_array_equal(gradient_of_billiards(steps), [0.0, 0.0])


def true_slope_of_billiards(steps: int, way: np.ndarray) -> float:
    """Return the derivative of |centre of B - goal|^2 along a direction of A's velocity, by a complex step."""
    model, inputs = billiards(steps, V)
    turned = copy.deepcopy(inputs)
    make_complex(turned)
    turned.state.v[:200] += 1e-30j * way
    _, last, _ = reference.rollout(model, turned)
    return float((miss(last) ** 2).sum().imag / 1e-30)


@pytest.mark.parametrize("steps", PAPER_B)
def test_b_after_collisions(steps):
    gradient = gradient_of_billiards(steps)
    way = np.array([0.6, 0.8])
    truth = true_slope_of_billiards(steps, way)
    assert gradient @ way == pytest.approx(truth, rel=min(PAPER_B[steps], 1e-8))
    if steps == 1000:  # the second disc has been thrown into a corner, and back
        assert final(*billiards(steps, V)).x[200:, 0].max() > 0.85


def test_b_by_the_papers_own_differences():
    """Central differences at 100 substeps: their truncation falls with the square of the step down to 2.39e-8."""
    gradient = gradient_of_billiards(100)

    def differences(h: float) -> np.ndarray:
        loss = [[(miss(final(*billiards(100, V + s * h * e))) ** 2).sum() for s in (1, -1)] for e in np.eye(2)]
        return np.array([(ahead - behind) / (2 * h) for ahead, behind in loss])

    errors = [float(np.linalg.norm(differences(h) - gradient) / np.linalg.norm(gradient)) for h in (1e-3, 1e-4, 1e-5)]
    assert errors[0] < 1e-3
    assert errors[1] < 3e-5
    assert errors[2] < PAPER_B[100]


class Finger:
    """C: two muscles bend a finger; tanh(W z + b) of the centroids' positions and velocities and of the goal."""

    def __init__(self, steps: int, real: type = np.float64) -> None:
        boxes = [([0.4, 0.1], [0.1, 0.4]), ([0.5, 0.1], [0.1, 0.4]), ([0.4, 0.5], [0.2, 0.2])]
        # 40 x 40 in each box: a lattice of cells as long and as wide in parts of the box
        unit = lattice([0.0, 0.0], [1.0, 1.0], 1 / 40)
        x = np.concatenate([np.array(corner) + unit * size for corner, size in boxes])
        groups = {name: np.arange(1600 * k, 1600 * (k + 1)) for k, name in enumerate(("left", "right", "tip"))}
        walls = [
            *(Wall(Friction, (n, 0), nodes, 0.5) for n, nodes in ((1, below(0, 0.05)), (-1, above(0, 0.925)))),
            *(Wall(Friction, (0, n), nodes, 0.5) for n, nodes in ((1, below(1, 0.05)), (-1, above(1, 0.925)))),
            Wall(Sticky, (0, 0), below(1, 6 / 40)),
        ]
        along = np.diag([0.0, 1.0])
        model, self.inputs = world(
            x, size=[1.0, 1.0], dx=1 / 40, dt=DT_B, substeps=1, controls=steps, E=10.0, nu=0.3, walls=walls,
            muscles=((groups["left"], along), (groups["right"], along)), real=real,
        )  # fmt: skip
        self.inputs.strength[:] = 4.0
        matter = Matter(
            x, self.inputs.fields.mass, model.size, DT_B, steps, {"finger": slice(0, 4800)}, {"finger": groups},
            lambda body, region: np.arange(4800), {"target": 2}, 2,
        )  # fmt: skip
        seen = {"parts": Centroids(body="finger", range=None), "goal": Goal(goal="target", range=None)}
        self.observation = Observation.of(seen, matter)
        tip = sparse.csr_array((np.full(1600, 1 / 1600), (np.zeros(1600, int), groups["tip"])), shape=(1, 4800))
        self.model = replace(model, probe=sparse.csr_array(sparse.vstack([self.observation.rows, tip]).tocsr()))
        n = len(model.actuators)
        self.limits = Limits(np.full(n, -1.0), np.ones(n), np.full(n, np.inf), np.zeros(n))
        rng = np.random.default_rng(7)
        self.controller = LinearTanh()
        limits = self.limits.low, self.limits.high, self.limits.neutral
        blocks = self.controller.blocks(self.observation.size, n, steps, *limits, rng)
        self.weights = {block.name: block.initial for block in blocks}
        self.way = {name: rng.normal(size=a.shape) for name, a in self.weights.items()}

    def policy(self, h: complex) -> ControlPolicy:
        """Return the policy with its weights moved by h along a direction."""
        moved = {name: a + h * self.way[name] for name, a in self.weights.items()}
        return ControlPolicy(
            self.observation, self.controller, moved, self.limits, {"target": np.array([0.6, 0.6])}, DT_B, 2
        )

    def gap(self, records: Records) -> np.ndarray:
        """Return how far the tip is from the goal at the end (2,) [m]."""
        return records.x[-1, -1] - 0.6

    def loss(self, h: float) -> float:
        """Return |tip - goal|^2."""
        return float((self.gap(make_rollout(self.model, self.inputs, policy=self.policy(h)).run()) ** 2).sum())

    def slope(self) -> float:
        """Return the derivative along the direction, by the gradient."""
        policy = self.policy(0.0)

        def loss_bar(records: Records, last: State) -> LossBar:
            bar = Records.zeros(self.model.n_controls, records.x.shape[1], 2)
            bar.x[-1, -1] = 2 * self.gap(records)
            return LossBar(bar)

        rollout = make_rollout(self.model, self.inputs, adjoint=True, policy=policy)
        rollout.gradient(loss_bar)
        return float(sum((rollout.parameters_bar[name] * self.way[name]).sum() for name in self.way))

    def truth(self) -> float:
        """Return the derivative along the direction, by a complex step through the equations."""
        turned = copy.deepcopy(self.inputs)
        make_complex(turned)
        records, _, _ = reference.rollout(self.model, turned, self.policy(1e-30j))
        return float((self.gap(records) ** 2).sum().imag / 1e-30)


@pytest.mark.parametrize("steps", [1, 10, 100, pytest.param(1000, marks=pytest.mark.slow)])
def test_c_a_finger_and_its_controller(steps):
    finger = Finger(steps)
    assert finger.slope() == pytest.approx(finger.truth(), rel=min(PAPER_C[steps], 1e-9))


@pytest.mark.parametrize("steps", [1, 10, 100, pytest.param(1000, marks=pytest.mark.slow)])
def test_c_by_differences(steps):
    """The paper's own check."""
    finger = Finger(steps)
    differences = (finger.loss(STEP_C) - finger.loss(-STEP_C)) / (2 * STEP_C)
    assert finger.slope() == pytest.approx(differences, rel=PAPER_C[steps])

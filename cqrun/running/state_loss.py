"""The loss that `cqrun gradcheck` differentiates, and a function of the final state for scenes without a loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cqrun.build.model import Built
from cqrun.design.params import Block, Params
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.rollout import Rollout
from cqrun.plugin.contract import Array
from cqrun.scene.paths import canonical, leaf, leaves
from cqrun.state import MOTION, State

INSIDE = 0.025
"""Smallest distance of the checked point from the bounds, which are 1 apart: steps go in both directions."""

TYPICAL = {"m/s^2": 1.0, "m/s": 0.1, "rad/s": 0.1, "Pa s": 1.0, "N": 0.1, "kg": 0.01, "1/s": 1.0}
"""Typical size by unit of numbers that are 0 in the scene; 0.1 for other units."""


@dataclass(frozen=True)
class Loss:
    """A function of scaled values x.

    Attributes:
        words: its name as text.
        params: the blocks of x.
        x: the point (n,) of the check.
        value: returns f(x) from a forward run; raises RolloutError or TrialFailed if it blows up.
        value_and_grad: returns f and its gradient (n,) by the adjoint.
        scale: size of the terms of f; a small f may be the difference of large terms.
    """

    words: str
    params: Params
    x: Array
    value: Callable[[Array], float]
    value_and_grad: Callable[[Array], tuple[float, Array]]
    scale: float

    def interrupted_by(self, interrupt: Callable[[], None]) -> Loss:
        """Return the same function, which calls `interrupt` before every evaluation."""

        def value(x: Array) -> float:
            interrupt()
            return self.value(x)

        def value_and_grad(x: Array) -> tuple[float, Array]:
            interrupt()
            return self.value_and_grad(x)

        return replace(self, value=value, value_and_grad=value_and_grad)


def state_loss(built: Built, threads: int) -> Loss:
    """Return a random linear function of the final x, v, C and F, of all numbers that gradients reach.

    Each part is divided by its root mean square, so that all parts count.
    """
    params = Params(tuple(block_of(built, path) for path in reached(built)))
    rng = np.random.default_rng(built.scene.seed)

    def final(x: Array, adjoint: bool) -> Rollout:
        values = params.unpack(x)
        return make_rollout(built.model, built.assembly.inputs(values), threads=threads, adjoint=adjoint)

    def last_state(x: Array) -> State:
        last: list[State] = []
        final(x, adjoint=False).run(lambda control, state: last.append(state) if control == n_controls else None)
        return last[0]

    n_controls = built.model.n_controls
    state = last_state(params.start)
    weights = drawn_weights(state, rng)

    def value(x: Array) -> float:
        return product_of(last_state(x), weights)

    def value_and_grad(x: Array) -> tuple[float, Array]:
        losses: list[float] = []

        def loss_bar(records: Records, state: State) -> LossBar:
            losses.append(product_of(state, weights))
            return LossBar(final=weights)

        _, bar = final(x, adjoint=True).gradient(loss_bar)
        return losses[0], params.gradient(x, built.assembly.gradient(params.unpack(x), bar))

    scale = float(sum(np.abs(a * w).sum() for a, w in _pairs(state, weights)))
    return Loss("a random function of the final state", params, params.start, value, value_and_grad, scale)


def reached(built: Built) -> list[str]:
    """Return the key paths of all numbers that gradients reach."""
    return [
        canonical(built.scene, path)
        for path in leaves(built.scene, differentiable=True)
        if built.assembly.reaches(path)
    ]


def block_of(built: Built, path: str) -> Block:
    """Return a number of the scene as a block with bounds at 0.5 and 1.5 times it; scaled steps are relative."""
    info = leaf(built.scene, path)
    value = float(info.value)
    half = 0.5 * abs(value) if value else 0.5 * TYPICAL.get(info.unit, 0.1)
    return Block(path, value - half, value + half, False, np.array(value))


def drawn_weights(state: State, rng: np.random.Generator) -> State:
    """Return random weights of a state's parts, each divided by its root mean square."""

    def drawn(a: Array) -> Array:
        size = float(np.sqrt(np.mean(a**2)))
        return rng.normal(size=a.shape) / (size if size > 0 else 1.0)

    drawn_motion = {name: drawn(getattr(state, name)) for name in MOTION}
    history = {name: drawn(a) for name, a in state.history.items()}
    return State(**drawn_motion, memory=np.zeros_like(state.memory), history=history)


def _pairs(state: State, weights: State) -> list[tuple[Array, Array]]:
    return [(array, weights.arrays[name]) for name, array in state.arrays.items()]


def product_of(state: State, weights: State) -> float:
    """Return the sum of a state's numbers times weights."""
    return float(sum(np.vdot(a, w) for a, w in _pairs(state, weights)))

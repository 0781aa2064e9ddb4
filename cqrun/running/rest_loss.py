"""The loss that `cqrun gradcheck` differentiates for a scene with `job: rest`: a function of its equilibria."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cqrun.build.load_path import gradient_of, inputs_of, points_of
from cqrun.build.model import Built
from cqrun.design.params import Params
from cqrun.engine.statics.path import Found, RestPath
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.running.state_loss import Loss, block_of, drawn_weights, product_of, reached
from cqrun.state import State

TOLERANCE = 1e-12
"""Net force divided by the loads, at which differences are as exact as rounding allows."""


def rest_loss(built: Built, threads: int) -> Loss:
    """Return a random linear function of x and F at all points of a path, of all numbers that gradients reach.

    Numbers that the path sets at every point, and those that act in time alone, have no effect on it.
    """
    points = points_of(built)
    params = Params(tuple(block_of(built, path) for path in reached(built)))
    rng = np.random.default_rng(built.scene.seed)
    near: list[Found] = []

    def find(x: Array) -> tuple[RestPath, list[State]]:
        inputs = [inputs_of(built, point, params.unpack(x)) for point in points]
        path, states = RestPath(built.model, inputs, threads=threads, tolerance=TOLERANCE, near=near), list[State]()
        records = path.run(lambda k, here, point: states.append(here.state(point.rest.u)), keep=True)
        if not path.points[-1].rest.converged:
            raise TrialFailed(f"no equilibrium was found at point {len(path.points)} of {len(points)}")
        near[:] = near or records.found
        return path, states

    states = find(params.start)[1]
    weights = [replace(drawn_weights(state, rng), v=0.0 * state.v, C=0.0 * state.C) for state in states]

    def total(states: list[State]) -> float:
        return sum(product_of(*pair) for pair in zip(states, weights, strict=True))

    def value_and_grad(x: Array) -> tuple[float, Array]:
        path, states = find(x)
        values = params.unpack(x)
        bars = {key: np.zeros(np.shape(value)) for key, value in values.items()}
        for k, (point, weight) in enumerate(zip(points, weights, strict=True)):
            here = path.equilibrium(path.inputs[k])
            bar, _ = here.gradient(path.points[k].rest.u, state_bar=weight)
            for key, part in gradient_of(built, point, values, bar).items():
                bars[key] += part
        return total(states), params.gradient(x, bars)

    scale = sum(
        float(np.abs(getattr(s, name) * getattr(w, name)).sum())
        for s, w in zip(states, weights, strict=True)
        for name in ("x", "F")
    )
    words = f"a random function of {len(points)} equilibri{'um' if len(points) == 1 else 'a'}"
    return Loss(words, params, params.start, lambda x: total(find(x)[1]), value_and_grad, scale)

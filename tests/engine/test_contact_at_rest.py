"""Contact at equilibrium: obstacles and rigid bodies without friction, their tangent and the adjoint."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich_scene import product, random_state
from test_contact import ball, plane
from test_statics import cantilever

from cqrun.engine.model import Inputs
from cqrun.engine.rigid_model import NUMBERS, OFFSET, RigidModel
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.surface import ObstacleModel, SurfaceModel

NAMES = ("stone", "jaw")


def pressed(dim):
    """Return a cantilever between a ball above, a floor below, and a jaw that has come along its path; and inputs."""
    model, inputs = cantilever(dim)
    x, e = inputs.state.x, np.eye(dim)
    top, tip = x[:, -1].max(), x[:, 0].max()
    points = np.flatnonzero((x[:, -1] > top - 1e-9) | (x[:, -1] < x[:, -1].min() + 1e-9) | (x[:, 0] > tip - 1e-9))
    outward = np.where(x[points, -1:] > x[:, -1].mean(), 1.0, -1.0) * e[-1]
    dx, n = model.dx, len(points)
    K = np.full(n, 2e4 * dx ** (dim - 2))
    surface = SurfaceModel(x[points] + 0.2 * dx * outward, points, K, 0 * K, np.ones(n))
    middle = x.mean(axis=0)

    def full(a):
        return np.pad(a, (0, 3 - dim))

    over, end = middle.copy(), middle.copy()
    over[0] = 0.6 * x[:, 0].min() + 0.4 * tip
    over[-1], end[0] = top + 0.2 * dx + 0.8 * dx, tip + 1.6 * dx
    bodies = (
        RigidModel("stone", (ball(over, 1.5 * dx), ball(over + dx * e[0], dx)), full(over), 3 * dx),
        RigidModel("jaw", (plane(end, -e[0] - 0.3 * e[-1]),), full(end), 5.0, times=np.array([0.5, 1.0])),
    )
    low = middle.copy()
    low[-1] = x[:, -1].min() - 0.6 * dx
    floor = ObstacleModel(0, (plane(low, e[-1] + 0.1 * e[0]),), False)
    inputs.coefficients = np.zeros(len(model.conditions))
    inputs.rigid = np.zeros((2, NUMBERS))
    inputs.rigid[0, OFFSET] = full(0.02 * dx * np.ones(dim))
    inputs.waypoints = np.zeros((2, 6))
    inputs.waypoints[1, 0], inputs.waypoints[1, 5] = -1.75 * dx, 0.05
    return replace(model, surface=surface, rigid=bodies, obstacles=(floor,)), inputs


@pytest.fixture(scope="module", params=[2, 3], ids=["2D", "3D"])
def rested(request):
    """Return the model, its inputs, and where it rests."""
    model, inputs = pressed(request.param)
    equilibrium = Equilibrium(model, inputs)
    return model, inputs, equilibrium, equilibrium.solve(tolerance=1e-13)


def test_what_it_touches_pushes_it(rested):
    """Forces and moments of all that acts balance."""
    model, inputs, equilibrium, rest = rested
    assert rest.converged
    found, dim = equilibrium.held_by(rest.u), model.dim
    size = {name: np.abs(force).max() for name, (force, _) in found.items()}
    load = np.abs(inputs.fields.force.sum(axis=0)).max()
    assert all(size[name] > 1e-3 * load for name in (*NAMES, model.conditions[0].name)), size
    total = sum(force for force, _ in found.values()) + inputs.fields.force.sum(axis=0)
    assert np.abs(total).max() < 1e-9 * load
    stone, _ = found["stone"]
    assert stone[-1] < 0
    assert dim == len(stone)


def test_the_tangent_is_the_slope_of_the_forces_and_symmetric(rested, rng):
    _, _, equilibrium, rest = rested
    active = equilibrium.run.nodes.active

    def direction():
        p = np.zeros_like(rest.u)
        p[active, : equilibrium.dim] = rng.normal(size=(len(active), equilibrium.dim))
        return equilibrium.holding.freed(p) * 1e-5

    p, q = direction(), direction()
    equilibrium.linearise(rest.u)
    Kp, Kq = equilibrium.product(p).copy(), equilibrium.product(q).copy()
    assert (q * Kp).sum() == pytest.approx((p * Kq).sum(), rel=1e-10)
    ends = [equilibrium.net(rest.u + k * p).copy() for k in (-2, -1, 1, 2)]
    slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12
    np.testing.assert_allclose(-Kp, slope, rtol=0, atol=1e-7 * np.abs(slope).max())


def test_gradients_of_rigid_bodies_and_of_the_soft_one(rested):
    """Of the rest shape, and of the forces and moments that rigid bodies and boundaries give."""
    model, inputs, equilibrium, rest = rested
    rng, dim = np.random.default_rng(4), model.dim
    state_bar = random_state(equilibrium.state(rest.u), rng)
    moments = 1 if dim == 2 else 3
    held_bar = {name: (rng.normal(size=dim), rng.normal(size=moments)) for name in (*NAMES, model.conditions[0].name)}
    bar, solve = equilibrium.gradient(rest.u, state_bar=state_bar, held_bar=held_bar, tolerance=1e-12)
    assert solve.converged

    def loss(given: Inputs) -> float:
        there = Equilibrium(model, given)
        found = there.solve(rest.u, tolerance=1e-13)
        assert found.converged
        held = there.held_by(found.u)
        force = sum((held[name][k] * part).sum() for name, parts in held_bar.items() for k, part in enumerate(parts))
        return float(product(there.state(found.u), state_bar) + force)

    def changed(name: str, at: tuple[Any, ...], h: float) -> Inputs:
        other = copy.deepcopy(inputs)
        value = other.terms[0][0] if name == "E" else getattr(other, name)
        value[at] += h
        return other

    cases = [("rigid", (0, 0)), ("rigid", (0, dim - 1 if dim == 2 else 2)), ("rigid", (1, 0)), ("waypoints", (1, 0)),
             ("waypoints", (1, 5)), ("waypoints", (1, 1)), ("E", (0, slice(None)))]  # fmt: skip
    for name, at in cases:
        h = 1e-6 if name != "E" else 10.0
        ends = [loss(changed(name, at, k * h)) for k in (-2, -1, 1, 2)]
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        found = (bar.terms[0][0] if name == "E" else getattr(bar, name))[at].sum()
        assert found == pytest.approx(slope, rel=2e-6, abs=1e-7 * abs(bar.rigid).max() * (name != "E")), (name, at)
    assert not bar.waypoints[0].any()

"""Reactions of boundaries: they carry the loads, and their gradients are those of differences."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from test_statics import KINDS, cantilever

from cqrun.engine.setting import grid_shape, node_positions
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.reactions import Holder, resultant, resultant_vjp


def on_two_walls(dim):
    """Return the cantilever, whose far end may only move along a wall, with its inputs."""
    model, inputs = cantilever(dim)
    far = node_positions(grid_shape(model.size, model.dx), model.dx)[:, 0] >= 0.85
    conditions = tuple(
        replace(c, nodes=far) if c.name == "slip" and not np.any(c.nodes) and k == SLIP else c
        for k, c in enumerate(model.conditions)
    )
    return replace(model, conditions=conditions), inputs


SLIP = 4
"""The first slipping condition of the little worlds; its normal is x."""

STEP = 5e-4
"""Part of a value by which it changes: its fourth power is the error of differences."""


@pytest.fixture(scope="module", params=[2, 3], ids=["2D", "3D"])
def rested(request):
    """Return a model, its inputs, equilibrium and rest."""
    model, inputs = on_two_walls(request.param)
    equilibrium = Equilibrium(model, inputs)
    return model, inputs, equilibrium, equilibrium.solve(tolerance=1e-13)


def test_the_reactions_of_all_boundaries_carry_all_loads(rested):
    _, inputs, equilibrium, rest = rested
    held = equilibrium.held_by(rest.u)
    assert set(held) == {"sticky", "slip"}
    total = sum(force for force, _ in held.values())
    np.testing.assert_allclose(total, -inputs.fields.force.sum(axis=0), rtol=0, atol=1e-9 * np.abs(total).max())
    assert abs(held["slip"][0][0]) > 0.01 * np.abs(total).max()
    assert np.abs(held["slip"][0][1:]).max() <= 1e-12 * np.abs(total).max()  # it holds along its normal alone


def test_the_adjoint_of_a_resultant(rested, rng):
    """A dot product: force and moment depend on the reactions and, by the arms, on the displacements."""
    _, _, equilibrium, _ = rested
    n, dim = equilibrium.n_nodes, equilibrium.dim
    nodes = rng.choice(n, 12, replace=False)
    holder = Holder(nodes, rng.normal(size=(12, dim)), rng.normal(size=(12, dim, dim)))
    u, r = rng.normal(size=(n, 4)), rng.normal(size=(n, dim))
    du, dr = rng.normal(size=(n, 4)), rng.normal(size=(n, dim))
    R_bar, M_bar = rng.normal(size=dim), rng.normal(size=1 if dim == 2 else 3)

    def at(h):
        R, M = resultant(holder, u + h * du, r + h * dr)
        return R @ R_bar + M @ M_bar

    r_bar, a_bar = resultant_vjp(holder, u, r, R_bar, M_bar)
    backward = (r_bar * dr[nodes]).sum() + (a_bar * du[nodes, :dim]).sum()
    forward = (at(1.0) - at(-1.0)) / 2  # exact: it is of second order
    assert backward == pytest.approx(forward, rel=1e-12)


def loss_of(equilibrium, u, weights, *, with_record):
    """Return a curved loss of all reactions, and of the record; and its cotangents."""
    held, loss, bars = equilibrium.held_by(u), 0.0, {}
    for name, (force, moment) in held.items():
        a, b = weights[name]
        loss += float(np.sin(a * force).sum() + np.cos(b * moment).sum())
        bars[name] = a * np.cos(a * force), -b * np.sin(b * moment)
    record = equilibrium.record(u)
    if with_record:
        loss += float(np.sin(3 * record).sum())
    return loss, bars, 3 * np.cos(3 * record) if with_record else None


@pytest.mark.parametrize("with_record", [False, True], ids=["reactions", "reactions and record"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_that_of_differences(rested, kind, with_record, rng):
    model, inputs, equilibrium, rest = rested
    held = equilibrium.held_by(rest.u)
    weights = {name: (0.7 / np.abs(f).max(), 0.4 / np.abs(m).max()) for name, (f, m) in held.items()}
    _, held_bar, record_bar = loss_of(equilibrium, rest.u, weights, with_record=with_record)
    gradient, solved = equilibrium.gradient(rest.u, record_bar=record_bar, held_bar=held_bar, tolerance=1e-13)
    assert solved.converged
    value = KINDS[kind](inputs)
    change = 0.5 * value if kind == "volume" else rng.normal(size=value.shape) * np.abs(value)
    slope = (KINDS[kind](gradient) * change).sum()
    losses = []
    for k in (-2, -1, 1, 2):
        there = copy.deepcopy(inputs)
        KINDS[kind](there)[...] += k * STEP * change
        moved = Equilibrium(model, there)
        losses.append(loss_of(moved, moved.solve(rest.u, tolerance=1e-13).u, weights, with_record=with_record)[0])
    difference = (losses[0] - 8 * losses[1] + 8 * losses[2] - losses[3]) / (12 * STEP)
    assert abs(difference) > 0
    assert slope == pytest.approx(difference, rel=1e-7)

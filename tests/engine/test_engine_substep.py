"""The compiled substep against the equations, and what a transfer must carry exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference
from little_worlds import TERMS, world
from rich_scene import parts, rich

from cqrun.engine.frames import make_rollout
from cqrun.engine.model import GroupModel
from cqrun.state import State

TOLERANCE = 1e-12


@pytest.mark.parametrize("dim", [2, 3])
def test_a_rollout_is_that_of_the_equations(dim):
    model, inputs = rich(dim)
    seen: dict[int, State] = {}
    records = make_rollout(model, inputs).run(observe=seen.__setitem__)
    expected, last, branches = reference.rollout(model, inputs)
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE * np.abs(want).max())
    for got, want in zip(parts(seen[model.n_controls]), parts(last), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE * np.abs(want).max())
    # every kind of wall was met, and every branch of friction and of separation
    met = {(kind, *last) for taken in branches for kind, _, *last in taken}
    walls = {(kind, branch) for kind, *_, branch in met if kind not in ("cable", "tension")}
    assert walls == {
        ("friction", 0), ("friction", 1), ("friction", 2), ("slip", 0), ("separate", 0), ("separate", 1), ("sticky", 0),
    }  # fmt: skip
    # and each side of a cable: taut and slack, and taut with a negative signal
    assert {cable for cable in met if cable[0] == "cable"} == {
        ("cable", True, True), ("cable", False, True), ("cable", True, False),
    }  # fmt: skip
    assert {cable for cable in met if cable[0] == "tension"} == {("tension", True), ("tension", False)}


@pytest.mark.parametrize("dim", [2, 3])
def test_so_is_one_of_particles_that_cross_a_block_between_sortings(dim):
    """At .9 cells a substep a block of 4 is crossed in 5, and particles are sorted every 8 if nobody looks."""
    model, inputs = rich(dim, substeps=10, controls=2)
    planes = tuple(replace(c, nodes=np.zeros(36 * 16 ** (dim - 1), bool)) for c in model.conditions)
    model = replace(model, size=np.array([2.9] + [0.9] * (dim - 1)), conditions=planes)
    assert model.grid_shape == (36,) + (16,) * (dim - 1)
    inputs.state.v[:, 0] += 22.0
    records = make_rollout(model, inputs).run()
    expected, last, _ = reference.rollout(model, inputs)
    assert (last.x[:, 0] - inputs.state.x[:, 0]).min() > 1.5
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE * np.abs(want).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_bodies_with_other_terms_than_their_neighbours(dim, rng):
    """Two groups in one world, each with its own terms, are the bodies whose other moduli are zero."""
    model, inputs = rich(dim)
    one = [theta.copy() for theta in inputs.terms[0]]
    first, second = model.layout.slices()
    for term, gone in ((0, second), (1, first), (2, second), (3, first)):
        one[term][0, gone] = 0.0
    one[2][:, second] = 0.0
    inputs.terms = [one]
    inputs.activation[:], inputs.strength[:] = 0.0, 0.0
    expected, _, _ = reference.rollout(model, inputs)
    groups = (GroupModel((0,), (TERMS[0], TERMS[2])), GroupModel((1,), (TERMS[1], TERMS[3])))
    apart = replace(model, groups=groups, actuators=())
    inputs.terms = [[one[0][:, first], one[2][:, first]], [one[1][:, second], one[3][:, second]]]
    inputs.activation, inputs.strength, inputs.weights = np.zeros((model.n_controls, 0)), np.zeros(0), np.zeros(0)
    inputs.rest = np.zeros(0)
    records = make_rollout(apart, inputs).run()
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE * np.abs(want).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_an_affine_field_survives_the_grid(dim, rng):
    """Without stress, P2G and G2P give back v = a + B x exactly, wherever the particles are (APIC)."""
    x = 0.3 + 0.4 * rng.random((40, dim))
    model, inputs = world(x, size=[1.0] * dim, dx=0.1, dt=1e-3, substeps=1, controls=1, mass=rng.uniform(1, 2, 40))
    a, B = rng.normal(size=dim), rng.normal(size=(dim, dim))
    inputs.state.v, inputs.state.C = a + x @ B.T, np.tile(B, (40, 1, 1))
    seen: dict[int, State] = {}
    make_rollout(model, inputs).run(observe=seen.__setitem__)
    after = seen[1]
    np.testing.assert_allclose(after.v, inputs.state.v, rtol=0, atol=1e-14)
    np.testing.assert_allclose(after.C, inputs.state.C, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.x, x + 1e-3 * inputs.state.v, rtol=0, atol=1e-15)
    np.testing.assert_allclose(after.F, np.eye(dim) + 1e-3 * inputs.state.C, rtol=0, atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_forces_and_damping_act_on_the_particles_momentum(dim, rng):
    """p' = exp(-damping dt) m v + dt f, summed over all particles, to round-off."""
    x = 0.3 + 0.4 * rng.random((40, dim))
    mass, damping = rng.uniform(1, 2, 40), rng.uniform(0, 50, 40)
    model, inputs = world(
        x, size=[1.0] * dim, dx=0.1, dt=1e-2, substeps=1, controls=1, mass=mass, volume=1e-3, E=10.0, damping=damping
    )
    inputs.state.v[:], inputs.fields.force[:] = rng.normal(size=(2, 40, dim))
    seen: dict[int, State] = {}
    make_rollout(model, inputs).run(observe=seen.__setitem__)
    kept = (mass * np.exp(-damping * 1e-2)) @ inputs.state.v
    np.testing.assert_allclose(mass @ seen[1].v, kept + 1e-2 * inputs.fields.force.sum(0), rtol=0, atol=1e-13)

"""Nodes that several boundaries hold: how their reactions are divided, and the gradient of it."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from cqrun.build.load_path import inputs_of
from cqrun.build.model import build
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.holding import Planes
from cqrun.scene.load import load_scene

LOW = {"slip": {"region": {"box": {"corner": [0, 0], "size": [0.2, 0.055]}}, "normal": [0, 1]}}
LEFT = {"slip": {"region": {"box": {"corner": [0, 0], "size": [0.055, 0.2]}}, "normal": [1, 0]}}
SLOPE = {"slip": {"region": {"box": {"corner": [0, 0], "size": [0.2, 0.055]}}, "normal": [0.6, 0.8]}}
TOP = {"sticky": {"region": {"box": {"corner": [0, 0.145], "size": [0.2, 0.055]}}, "displacement": [0.003, 0.01]}}
STILL = {"sticky": {"region": {"box": {"corner": [0, 0.135], "size": [0.2, 0.065]}}}}


def square(**boundaries):
    """Return the built scene of a square of 10 x 10 cells without gravity, held by boundaries in this order."""
    material = {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}}
    box = {"box": {"corner": [0.05, 0.05], "size": [0.1, 0.1]}}
    return build(load_scene({
        "cqrun": 1, "job": "rest", "world": {"size": [0.2, 0.2], "dx": 0.01, "gravity": [0, 0], "frame": "reference"},
        "bodies": {"square": {"shape": box, "particles_per_cell": 4, "material": material}}, "boundaries": boundaries,
    }))  # fmt: skip


def rested(**boundaries):
    """Return the equilibrium of such a square, and its displacement."""
    built = square(**boundaries)
    equilibrium = Equilibrium(built.model, inputs_of(built, {}))
    rest = equilibrium.solve(tolerance=1e-11)
    assert rest.converged
    return equilibrium, rest.u


@pytest.fixture(scope="module")
def held():
    """Return the reactions on a square that is pulled from a corner of two frictionless planes."""
    equilibrium, u = rested(low=LOW, left=LEFT, top=TOP)
    return equilibrium.held_by(u)


def test_a_frictionless_plane_takes_no_force_along_itself(held):
    """The planes share nodes with each other and with the clamp; without loads all reactions balance."""
    scale = np.abs(held["top"][0]).max()
    assert scale > 100
    assert abs(held["left"][0][1]) < 1e-12 * scale
    assert abs(held["low"][0][0]) < 1e-12 * scale
    assert held["low"][0][1] == pytest.approx(-held["top"][0][1], rel=1e-9)
    assert held["left"][0][0] == pytest.approx(-held["top"][0][0], rel=1e-9)


@pytest.mark.parametrize("order", [("top", "left", "low"), ("left", "top", "low")])
def test_the_order_of_boundaries_does_not_matter(held, order):
    known = {"low": LOW, "left": LEFT, "top": TOP}
    equilibrium, u = rested(**{name: known[name] for name in order})
    for name, (force, moment) in equilibrium.held_by(u).items():
        np.testing.assert_allclose(force, held[name][0], rtol=0, atol=1e-8 * np.abs(held["top"][0]).max())
        np.testing.assert_allclose(moment, held[name][1], rtol=0, atol=1e-8 * np.abs(held["top"][0]).max())


def test_planes_at_an_acute_angle_take_forces_along_their_normals():
    """The corner nodes cannot move at all, although each plane alone would let them slide."""
    equilibrium, u = rested(slope=SLOPE, left=LEFT, top=TOP)
    held = equilibrium.held_by(u)
    scale = np.abs(held["top"][0]).max()
    assert abs(held["left"][0][1]) < 1e-12 * scale
    assert abs(held["slope"][0] @ [0.8, -0.6]) < 1e-12 * scale
    total = sum(force for force, _ in held.values())
    np.testing.assert_allclose(total, 0.0, rtol=0, atol=1e-9 * scale)
    X = equilibrium._places()
    corner = (equilibrium.run.nodes.bits == 3) & (X[:, 0] < 0.056) & (X[:, 1] < 0.056)
    assert corner.any()
    assert not u[corner].any()


@pytest.mark.parametrize(("first", "taker"), [("still", "still"), ("other", "other")])
def test_of_two_clamps_the_first_takes_the_nodes_of_both(first, taker):
    clamps = dict(sorted({"still": STILL, "other": STILL}.items(), key=lambda item: item[0] != first))
    equilibrium, u = rested(low=TOP | {"sticky": TOP["sticky"] | {"region": LOW["slip"]["region"]}}, **clamps)
    held = equilibrium.held_by(u)
    assert np.abs(held[taker][0]).max() > 100
    assert not held["other" if taker == "still" else "still"][0].any()


def test_a_clamp_that_carries_nodes_takes_their_reactions():
    """Whatever the order, because the nodes go where it goes."""
    for boundaries in ({"still": STILL, "low": LOW, "top": TOP}, {"top": TOP, "low": LOW, "still": STILL}):
        built = square(**boundaries)
        equilibrium = Equilibrium(built.model, inputs_of(built, {}))
        planes = Planes(built.model.conditions, built.model.size, equilibrium.run.nodes.bits, equilibrium._places())
        shared = int((planes.of("top") & planes.of("still")).sum())
        assert shared > 0
        assert planes.alike() == {("top", "still"): shared}


def test_the_gradient_of_shared_reactions_is_that_of_differences(rng):
    """Of all forces and moments, by the moduli of all particles and the displacement of the clamp."""
    built = square(slope=SLOPE, left=LEFT, top=TOP)
    inputs = inputs_of(built, {})
    equilibrium = Equilibrium(built.model, inputs)
    u = equilibrium.solve(tolerance=1e-12).u
    bars = {name: (rng.normal(size=2), 20 * rng.normal(size=1)) for name in equilibrium.held_by(u)}

    def loss(there):
        moved = Equilibrium(built.model, there)
        held = moved.held_by(moved.solve(u, tolerance=1e-13).u)
        return sum(float(force @ bars[name][0] + moment @ bars[name][1]) for name, (force, moment) in held.items())

    bar, solved = equilibrium.gradient(u, held_bar=bars, tolerance=1e-13)
    assert solved.converged
    for value_of, size in ((lambda i: i.terms[0][0][0], 1e5), (lambda i: i.moves, 1e-3)):
        change = size * rng.normal(size=value_of(inputs).shape) * 0.1
        losses = []
        for k in (-2, -1, 1, 2):
            there = copy.deepcopy(inputs)
            value_of(there)[...] += k * 1e-2 * change
            losses.append(loss(there))
        difference = (losses[0] - 8 * losses[1] + 8 * losses[2] - losses[3]) / 0.12
        assert abs(difference) > 0
        assert (value_of(bar) * change).sum() == pytest.approx(difference, rel=1e-7)

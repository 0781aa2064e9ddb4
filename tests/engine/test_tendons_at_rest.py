"""Tendons that rub, at rest: the capstan, the elastica, and gradients where the tangent is not symmetric."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit
from scipy import sparse

from cqrun.build.load_path import inputs_of
from cqrun.build.model import Built, build
from cqrun.engine.model import Inputs
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.krylov import conjugate_gradients, dot, minimal_residuals
from cqrun.engine.statics.path import RestPath
from cqrun.scene.load import load_scene

ACTIVE = {"signals": {"rope": [1]}}


def beam(*, dx: float = 0.01, height: float = 0.02, **cable: Any) -> dict[str, Any]:
    """Return a beam of 20 cm with a tendon 30 % of its height below its middle, clamped where the tendon begins."""
    low = 0.15 + 0.2 * height
    spec = {"body": "beam", "route": [[0.04, low], [0.24, low]], "spacing": dx} | cable
    return {
        "cqrun": 1, "job": "rest", "world": {"size": [0.32, 0.32], "dx": dx, "gravity": [0, -9.81]},
        "bodies": {"beam": {
            "shape": {"box": {"corner": [0.02, 0.15], "size": [0.22, height]}}, "particles_per_cell": 4,
            "material": {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e6, "poissons_ratio": 0}}},
        }},
        "boundaries": {"clamp": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.04, 0.32]}}}}},
        "actuators": {"rope": {"cable": spec}}, "activation": ACTIVE,
    }  # fmt: skip


def drum(**cable: Any) -> dict[str, Any]:
    """Return a stiff drum that is held inside, and a rope around its upper half, from a pulley to an anchor."""
    angle = np.linspace(0, np.pi, 25)
    route = 0.2 + 0.04 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    spec = {"body": "drum", "route": route.tolist(), "pulley": [0.24, 0.05], "anchor": [0.16, 0.05]} | cable
    return {
        "cqrun": 1, "job": "rest", "world": {"size": [0.4, 0.4], "dx": 0.01, "gravity": [0, 0]},
        "bodies": {"drum": {
            "shape": {"ball": {"center": [0.2, 0.2], "radius": 0.05}}, "particles_per_cell": 9,
            "material": {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e8, "poissons_ratio": 0}}},
        }},
        "boundaries": {"core": {"sticky": {"region": {"ball": {"center": [0.2, 0.2], "radius": 0.03}}}}},
        "actuators": {"rope": {"cable": spec}}, "activation": ACTIVE,
    }  # fmt: skip


def rested(scene: dict[str, Any], tolerance: float = 1e-9) -> tuple[Built, RestPath]:
    built = build(load_scene(scene))
    path = RestPath(built.model, [inputs_of(built, {})], tolerance=tolerance)
    path.run()
    assert path.points[0].rest.converged
    return built, path


# --- known answers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mu", [None, 0.1, 0.3])
def test_a_drum_is_pulled_by_both_ends_of_a_rope_around_it(mu):
    """The rope leaves the drum with exp(-mu pi) of its tension: what the core holds says so."""
    _, path = rested(drum(tension=2.0, **({} if mu is None else {"friction": mu})))
    end = 2.0 * np.exp(-(mu or 0.0) * np.pi)
    force = path.held["core"][1]
    assert force[:2] == pytest.approx([0.0, 2.0 + end], rel=1e-6, abs=1e-6)
    assert force[2] == pytest.approx(0.04 * (2.0 - end), rel=1e-5, abs=1e-6)


def test_the_end_of_a_rope_around_a_drum_is_drawn_by_its_length():
    """A spring at the driven end: the stretch of 1 mm gives 2 N there, less what the drum gives way."""
    scene = drum(stiffness=2e3, friction=0.3)
    length = 0.15 * 2 + 24 * 2 * 0.04 * np.sin(np.pi / 48)
    scene["activation"] = {"signals": {"rope": [1.0 - 1e-3 / length]}}
    _, path = rested(scene)
    assert path.held["core"][1][1] == pytest.approx(2.0 * (1.0 + np.exp(-0.3 * np.pi)), rel=1e-3)


def test_a_tendon_at_a_constant_offset_bends_a_beam_to_an_arc():
    """The elastica with a follower moment: T pulls along the beam with the arm e, so every section has the moment T e.

    The curvature, per length at rest, is T e / EI; the middle line is shorter by T / EA. Without a Poisson effect the
    law is linear in the principal stretches, so this holds for large angles, too. One height from either end the force
    has spread over the section.
    """
    height, arm, angle = 0.02, 0.3 * 0.02, 1.5
    tension = angle / 0.2 * 1e6 * height**3 / 12 / arm
    scene = beam(dx=height / 8, tension=tension)
    scene["world"]["gravity"] = [0, 0]
    built, path = rested(scene)
    state, x = path.equilibrium(path.inputs[0]).state(path.points[0].rest.u), built.particles.x
    places, turns = [], []
    for at in (0.06, 0.22):
        own = np.abs(x[:, 0] - at) < 0.5 * height / 8
        F = state.F[own].sum(axis=0)
        turns.append(np.arctan2(F[1, 0] - F[0, 1], F[0, 0] + F[1, 1]))
        places.append(state.x[own].mean(axis=0))
    curvature, length = angle / 0.2, 0.16
    assert turns[0] - turns[1] == pytest.approx(curvature * length, rel=0.006)
    c, s = np.cos(turns[0]), np.sin(turns[0])
    chord = np.array([[c, s], [-s, c]]) @ (places[1] - places[0])
    turned = curvature * length
    arc = np.array([np.sin(turned), np.cos(turned) - 1.0]) / curvature * (1.0 - tension / (1e6 * height))
    assert np.linalg.norm(chord - arc) < 0.006 * length


# --- an unsymmetric tangent -------------------------------------------------------------------------------------------

RUBS = {"tension": {"tension": 120.0, "friction": 0.4}, "length": {"stiffness": 4e4, "friction": 0.4}}


@pytest.fixture(scope="module", params=RUBS)
def bent(request):
    """Return the model, inputs, equilibrium and rest of a beam whose rope goes on to an anchor below."""
    scene = beam(anchor=[0.26, 0.06], **RUBS[request.param])
    if request.param == "length":
        scene["activation"] = {"signals": {"rope": [0.8]}}
    built = build(load_scene(scene))
    count = len(built.particles.x)
    probe = sparse.csr_array(np.random.default_rng(1).random((2, count)) / count)
    model, inputs = replace(built.model, probe=probe), inputs_of(built, {})
    # not a lattice: there the ghost penalty has kinks
    inputs.state.x += 1e-3 * np.random.default_rng(11).normal(size=inputs.state.x.shape) * 0.2
    inputs.shaped = True
    equilibrium = Equilibrium(model, inputs)
    rest = equilibrium.solve(tolerance=1e-12)
    assert rest.converged
    assert np.abs(rest.u).max() > 0.01
    return model, inputs, equilibrium, rest


def test_products_with_the_tangent_and_its_transpose(bent, rng):
    _, _, equilibrium, rest = bent
    assert not equilibrium.symmetric
    active = equilibrium.run.nodes.active
    p, q = (np.zeros_like(rest.u) for _ in range(2))
    p[active, :2], q[active, :2] = 1e-2 * rng.normal(size=(2, len(active), 2))
    p, q = equilibrium.holding.freed(p), equilibrium.holding.freed(q)
    equilibrium.linearise(rest.u)
    Kp, Kq = equilibrium.product(p).copy(), equilibrium.product_vjp(q).copy()
    assert dot(q, Kp) == pytest.approx(dot(p, Kq), rel=1e-12)
    assert abs(dot(q, Kp) - dot(p, equilibrium.product(q))) > 1e-6 * abs(dot(q, Kp))
    # so small a step that no bend of the rope, some of 1e-5, turns the other way
    ends = [equilibrium.net(rest.u + k * 1e-6 * p).copy() for k in (-2, -1, 1, 2)]
    slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-6
    np.testing.assert_allclose(-slope, Kp, rtol=0, atol=1e-7 * np.abs(Kp).max())


def loss_of(equilibrium: Equilibrium, u: np.ndarray) -> tuple[float, np.ndarray, dict[str, Any]]:
    """Return a loss of the record and the reaction at u, and its cotangents."""
    record, (force, moment) = equilibrium.record(u), equilibrium.held_by(u)["clamp"]
    value = np.sin(3 * record).sum() + 1e-3 * (force @ [1.0, 0.7]) + 1e-2 * moment[0]
    return float(value), 3 * np.cos(3 * record), {"clamp": (1e-3 * np.array([1.0, 0.7]), np.full(1, 1e-2))}


KINDS = {
    "friction": lambda inputs: inputs.friction,
    "strength": lambda inputs: inputs.strength,
    "activation": lambda inputs: inputs.activation,
    "rest length": lambda inputs: inputs.rest,
    "E": lambda inputs: inputs.terms[0][0][0],
    "weight": lambda inputs: inputs.fields.force,
    "places": lambda inputs: inputs.state.x,
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_that_of_differences(bent, kind):
    model, inputs, equilibrium, rest = bent
    _, record_bar, held_bar = loss_of(equilibrium, rest.u)
    gradient, solve = equilibrium.gradient(rest.u, record_bar=record_bar, held_bar=held_bar, tolerance=1e-13)
    assert solve.converged
    change = KINDS[kind](inputs)
    if kind == "places":
        change = 1e-3 * np.random.default_rng(2).normal(size=change.shape)
    losses = []
    for k in (-2, -1, 1, 2):
        there = Inputs(**{**vars(inputs), "friction": inputs.friction.copy()})
        there = replace(there, terms=[[t.copy() for t in group] for group in inputs.terms])
        there = replace(there, strength=inputs.strength.copy(), activation=inputs.activation.copy())
        there = replace(there, rest=inputs.rest.copy(), fields=replace(inputs.fields, force=inputs.fields.force.copy()))
        there = replace(there, state=replace(inputs.state, x=inputs.state.x.copy()))
        KINDS[kind](there)[...] += k * 1e-4 * change
        moved = Equilibrium(model, there)
        losses.append(loss_of(moved, moved.solve(rest.u, tolerance=1e-13).u)[0])
    difference = (losses[0] - 8 * losses[1] + 8 * losses[2] - losses[3]) / 12e-4
    if kind == "rest length" and inputs.strength[0] == 120.0:
        assert abs(difference) < 1e-10
        assert (KINDS[kind](gradient) * change).sum() == 0.0
        return
    assert abs(difference) > 1e-6
    assert (KINDS[kind](gradient) * change).sum() == pytest.approx(difference, rel=1e-7)


@needs_jit
def test_any_number_of_threads_gives_the_same_bits():
    built = build(load_scene(beam(tension=120.0, friction=0.4)))
    inputs, found = inputs_of(built, {}), []
    for threads in (1, 2):
        equilibrium = Equilibrium(built.model, inputs, threads=threads)
        rest = equilibrium.solve()
        bar, _ = equilibrium.gradient(rest.u, held_bar={"clamp": (np.ones(2), np.ones(1))})
        found.append((rest.u.tobytes(), bar.friction.tobytes(), bar.terms[0][0].tobytes()))
    assert found[0] == found[1]


def test_without_friction_equilibria_keep_conjugate_gradients():
    for cable, solver in (({}, conjugate_gradients), ({"friction": 0.1}, minimal_residuals)):
        built = build(load_scene(beam(tension=1.0, **cable)))
        assert Equilibrium(built.model, inputs_of(built, {})).solver is solver

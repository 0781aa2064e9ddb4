"""The adjoint of whole rollouts: dot products against complex steps of the equations, and Taylor remainders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference
from little_worlds import TERMS, world
from rich_scene import (
    KINDS,
    arrays,
    direction,
    moved,
    parts,
    product,
    random_records,
    random_state,
    rebuilt,
    rich,
)

from cqrun.actuators import muscle
from cqrun.actuators.cable import Cable
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import GroupModel, LossBar, Records
from cqrun.plugin.registry import plugins

DOT_PRODUCT = 1e-9
TINY = 1e-30


@pytest.fixture(scope="module", params=[2, 3], ids=["2D", "3D"])
def adjoint(request):
    """Return a rich model, its inputs, cotangents of records and last state, and the gradient."""
    rng = np.random.default_rng(7)
    model, inputs = rich(request.param)
    records_bar = random_records(Records.zeros(model.n_controls, 3, model.dim, model.layout.history), rng)
    state_bar = random_state(inputs.state, rng)
    _, bar = make_rollout(model, inputs, adjoint=True).gradient(lambda records, state: LossBar(records_bar, state_bar))
    return model, inputs, records_bar, state_bar, bar


@pytest.mark.parametrize("kind", KINDS)
def test_dot_product(adjoint, kind, rng):
    model, inputs, records_bar, state_bar, bar = adjoint
    change = direction(inputs, kind, rng)
    records, last, _ = reference.rollout(model, moved(inputs, kind, 1j * TINY * change))
    forward = (product(records, records_bar) + product(last, state_bar)).imag / TINY
    backward = (arrays(bar)[KINDS.index(kind)] * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


def test_every_kind_of_actuator_is_in_the_rich_scene():
    kernels = {part.kernel for part in rich(2)[0].actuators if len(part.particles)}
    example = {"body": "b", "axis": [1, 0], "strength": 1, "max_pressure": 1, "stiffness": 1, "route": [[0, 0], [1, 1]],
               "direction": [1, 0], "acceleration": 1}  # fmt: skip
    for name, kind in plugins("actuator").items():
        if kind.frame == "reference":  # this scene is of the other frame; tests/actuators/test_chambers.py
            continue
        given = {key: value for key, value in example.items() if key in kind.model_fields}
        assert kind.model_validate(given).kernel in kernels, name
    assert Cable(body="b", route=[[0.0, 0.0], [1.0, 1.0]], tension=1.0).kernel in kernels


def test_memory_passes_through(adjoint):
    _, _, _, state_bar, bar = adjoint
    np.testing.assert_array_equal(bar.state.memory, state_bar.memory)


def test_coefficients_of_walls_without_friction_do_nothing(adjoint):
    model, _, _, _, bar = adjoint
    rubs = np.array([c.spec.name == "friction" and c.nodes.any() for c in model.conditions])
    assert np.all(bar.coefficients[~rubs] == 0.0)
    assert np.all(bar.coefficients[rubs] != 0.0)


def test_nothing_asked_nothing_answered(adjoint):
    """The adjoint is linear: cotangents of zero give gradients of zero."""
    model, inputs, *_ = adjoint
    _, bar = make_rollout(model, inputs, adjoint=True).gradient(lambda records, state: LossBar())
    assert all(not a.any() for a in arrays(bar))


def test_the_gradient_by_mass_is_not_the_printed_one(rng):
    """CQ2 (A90) prints sum_i N_i dL/dm_i: the momentum m (v + C d) that the mass carries is left out.

    One substep of free particles and L = sum_p w_p . v'_p: v_i = p_i / m_i, so dL/dp_i = V_i / m_i and
    dL/dm_i = -V_i . v_i / m_i with V_i = sum_p N_ip w_p.
    """
    x, w = 0.45 + 0.2 * rng.random((12, 2)), rng.normal(size=(12, 2))
    model, inputs = world(
        x, size=[1.0, 1.0], dx=0.1, dt=1e-3, substeps=1, controls=1, mass=rng.uniform(1, 2, 12), probe=np.eye(12)
    )
    inputs.state.v[:], inputs.state.C[:] = rng.normal(size=(12, 2)), rng.normal(size=(12, 2, 2))
    records_bar = Records.zeros(1, 12, 2)
    records_bar.v[1] = w
    _, bar = make_rollout(model, inputs, adjoint=True).gradient(lambda records, state: LossBar(records_bar))

    s = reference.Moving(inputs.state.x, inputs.state.v, inputs.state.C, inputs.state.F)
    mv, m = reference.to_grid(model, inputs, s, 0)
    V = np.zeros_like(mv)
    for node, weight, _ in reference.stencil(model, x):
        np.add.at(V, node, weight[:, None] * w)
    printed, missing = np.zeros(12), np.zeros(12)
    for node, weight, arm in reference.stencil(model, x):
        carried = s.v + np.einsum("pij,pj->pi", s.C, arm)
        printed -= weight * (V[node] * mv[node]).sum(1) / m[node] ** 2
        missing += weight * (V[node] * carried).sum(1) / m[node]
    np.testing.assert_allclose(bar.fields.mass, printed + missing, rtol=0, atol=1e-12 * np.abs(missing).max())
    assert np.linalg.norm(printed - bar.fields.mass) > 0.5 * np.linalg.norm(bar.fields.mass)


def test_dot_product_where_bodies_have_other_terms(rng):
    """A body of one material beside a body of another, the second one alone with muscles."""
    model, inputs = rich(2)
    first, second = model.layout.slices()
    fixed, neo, viscous, _ = inputs.terms[0]
    keep = [a for a in model.actuators if a.name == "actuator 0"]
    keep = [replace(a, particles=a.particles[a.particles >= second.start]) for a in keep]
    groups = (GroupModel((0,), (TERMS[0], TERMS[2])), GroupModel((1,), (TERMS[1],), (muscle.MuscleKernel,)))
    apart = replace(model, groups=groups, actuators=tuple(keep), forces=())
    inputs.activation, inputs.strength, inputs.weights = inputs.activation[:, :1], inputs.strength[:1], np.zeros(0)
    inputs.rest = inputs.rest[:1]
    one = [a.copy() for a in inputs.terms[0]]
    one[0][0, second], one[1][0, first], one[2][:, second], one[3][0] = 0.0, 0.0, 0.0, 0.0
    inputs.terms = [[fixed[:, first], viscous[:, first]], [neo[:, second]]]
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2, model.layout.history), rng)
    _, bar = make_rollout(apart, inputs, adjoint=True).gradient(lambda records, state: LossBar(records_bar))
    got = {
        "x": bar.state.x, "F": bar.state.F, "muscle.activation": bar.activation,
        "fixed_corotated.E": np.pad(bar.terms[0][0][0], (0, 30)), "viscosity.bulk": np.pad(bar.terms[0][1][1], (0, 30)),
        "neo_hookean.nu": np.pad(bar.terms[1][0][1], (17, 0)),
    }  # fmt: skip
    inputs.terms = [one]
    for kind, gradient in got.items():
        # where the body has no such term, the equations would have one
        change = direction(inputs, kind, rng) * (gradient != 0.0)
        records, _, _ = reference.rollout(apart, moved(inputs, kind, 1j * TINY * change))
        forward = product(records, records_bar).imag / TINY
        assert (gradient * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT), kind


# --- Taylor remainders ----------------------------------------------------------------------------------

STEPS = 2.0 ** -np.arange(4, 20)
LONG = {"substeps": 8, "controls": 3, "seed": 4}
"""24 substeps: particles cross cells, and are sorted three times."""


def loss(records: Records) -> float:
    """Return a loss that is curved in all that is recorded."""
    return float(sum(np.sin(a).sum() + 0.5 * (a**2).sum() for a in parts(records)))


def loss_bar(records: Records, state: object) -> LossBar:
    """Return the cotangent of the loss."""
    return LossBar(rebuilt(records, [np.cos(a) + a for a in parts(records)]))


def branches(model, inputs) -> int:
    """Return a hash of the side and the branch that every held node took in every substep."""
    return hash(str(reference.rollout(model, inputs)[2]))


@pytest.fixture(scope="module", params=[2, 3], ids=["2D", "3D"])
def long_rollout(request):
    """Return a model, inputs, the loss, its gradient, and the branches taken."""
    model, inputs = rich(request.param, **LONG)
    records, bar = make_rollout(model, inputs, adjoint=True).gradient(loss_bar)
    return model, inputs, loss(records), bar, branches(model, inputs)


@pytest.mark.parametrize("kind", KINDS)
def test_taylor_remainder_is_of_second_order(long_rollout, kind, rng):
    """|f(p + h d) - f(p) - h <g, d>| falls by 4 as h halves, where no branch changes."""
    model, inputs, here, bar, taken = long_rollout
    change = direction(inputs, kind, rng)
    slope = (arrays(bar)[KINDS.index(kind)] * change).sum()
    remainders: list[float] = []
    for h in STEPS:
        there = moved(inputs, kind, h * change)
        if branches(model, there) == taken:
            remainders.append(abs(loss(make_rollout(model, there).run()) - here - h * slope))
        else:
            remainders.clear()
        if len(remainders) == 4:
            break
    assert len(remainders) == 4, "no four steps in a row take the branches of the point itself"
    assert np.log2(remainders[0] / remainders[-1]) / 3 >= 1.9, remainders

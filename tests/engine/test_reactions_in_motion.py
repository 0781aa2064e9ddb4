"""Reactions in motion: they are those of the equations, they balance all momentum, and their adjoint holds."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import total_lagrangian
from little_worlds import cases, needs_jit
from rich_scene import KINDS, arrays, direction, moved, parts, random_records
from test_contact import smooth, touched
from test_reference_frame import DOT_PRODUCT, SLOW, STEPS, TINY, compiled, completed
from touching import BODIES

from cqrun.boundaries.sticky import Sticky
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.surface import MeetingModel

ALL = ("sticky", "slip", "friction", "separate")
"""The boundaries of a rich model: the first two hold nodes, the others are touched."""

CHANGED = ("v", "C", "mass", "volume", "damping", "force", "fixed_corotated.E", "neo_hookean.nu", "viscosity.shear",
           "friction", "muscle.activation", "cable.rest", "cable.activation", "spring.strength")  # fmt: skip


def recorded(dim, *, viscous=True, **options):
    """Return a rich model that records all reactions, and its inputs."""
    model, inputs = touched(dim, viscous=viscous, seed={2: 0, 3: 9}[dim], **options)
    return replace(model, reactions=ALL), inputs


def meets_smoothly(model, inputs):
    """Return a model whose bodies meet without friction and dashpots, and its inputs."""
    inputs.coefficients[len(model.conditions)] = 0.0
    return replace(model, meeting=MeetingModel(False, 0.0)), inputs


def bar_of(model, seed=7):
    """Return random cotangents of reactions alone."""
    rng, size = np.random.default_rng(seed), 3 if model.dim == 2 else 6
    bar = Records.zeros(model.n_controls, 3, model.dim)
    bar.held = {name: rng.normal(size=(model.n_controls + 1, size)) for name in model.reactions}
    return bar


def product(records, bar):
    """Return the scalar product of reactions, which row 0 does not have."""
    return sum((records.held[name][1:] * rows[1:]).sum() for name, rows in bar.held.items())


@pytest.fixture(scope="module", params=cases(BODIES, ["2D viscous"]))
def case(request):
    """Return a model, its inputs, cotangents, the records and the gradient."""
    dim, viscous = request.param
    model, inputs = recorded(dim, viscous=viscous)
    bar = bar_of(model)
    rollout = make_rollout(*compiled(model, inputs, viscous), adjoint=True)
    records, inputs_bar = rollout.gradient(lambda records, state: LossBar(bar))
    return model, inputs, bar, records, completed(inputs_bar, viscous), viscous


def test_reactions_are_those_of_the_equations(case):
    model, inputs, _, records, _, _ = case
    expected, _ = total_lagrangian.rollout(model, inputs)
    assert set(records.held) == set(ALL)
    for name, want in expected.held.items():
        size = np.abs(want).max(axis=0)
        assert (size[: model.dim] > 0).any(), name
        np.testing.assert_allclose(records.held[name], want.real, rtol=0, atol=1e-10 * size.max())


@pytest.mark.parametrize("kind", CHANGED)
def test_dot_product(case, kind, rng):
    model, inputs, bar, _, inputs_bar, viscous = case
    if kind in SLOW and not viscous:
        pytest.skip("this material has no viscosity")
    change = direction(inputs, kind, rng)
    records, _ = total_lagrangian.rollout(model, moved(inputs, kind, 1j * TINY * change))
    forward = product(records, bar).imag / TINY
    backward = (arrays(inputs_bar)[KINDS.index(kind)] * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.parametrize("dim", [2, 3])
def test_dot_product_of_a_reversed_run(dim, rng):
    """Contact without friction and dashpots is reversed; in 2D, with the gradient by the positions at rest."""
    model, inputs = meets_smoothly(*recorded(dim, viscous=False))
    model, inputs.shaped = smooth(model), dim == 2
    bar = bar_of(model)
    rollout = make_rollout(*compiled(model, inputs, False), adjoint=True)
    _, inputs_bar = rollout.gradient(lambda records, state: LossBar(bar))
    assert rollout.plan.backwards
    found = arrays(completed(inputs_bar, False))
    kinds = ("v", "mass", "force", "damping", "fixed_corotated.E", "neo_hookean.nu", "cable.activation")
    for kind in ("x", *kinds) if inputs.shaped else kinds:
        change = direction(inputs, kind, rng)
        records, _ = total_lagrangian.rollout(model, moved(inputs, kind, 1j * TINY * change))
        forward = product(records, bar).imag / TINY
        backward = (found[KINDS.index(kind)] * change).sum()
        assert backward == pytest.approx(forward, rel=DOT_PRODUCT), kind


@pytest.mark.parametrize("dim", [2, 3])
def test_a_reversed_gradient_is_that_of_kept_states_and_of_checkpoints(dim):
    """Pieces between checkpoints begin inside control steps."""
    model, inputs = meets_smoothly(*recorded(dim, viscous=False, substeps=60))
    model, inputs = compiled(replace(smooth(model), dt=model.dt / 10), inputs, viscous=False)
    bar, found = bar_of(model), []
    size = make_rollout(model, inputs).start.nbytes
    for reversible, budget in ((True, 2**30), (False, 2**30), (False, 40 * size)):
        rollout = make_rollout(replace(model, memory_budget=budget, spare=[]), inputs, adjoint=True)
        rollout.reversible = reversible
        records, inputs_bar = rollout.gradient(lambda records, state: LossBar(bar))
        again = rollout.read_records().held
        assert all((records.held[name] == again[name]).all() for name in ALL)  # no part of a step overwrote them
        assert rollout.plan.backwards == reversible
        found.append((records.held, arrays(completed(inputs_bar, False))))
    assert rollout.plan.n_chunks > 1
    for held, gradient in found[1:]:
        assert all((held[name] == found[0][0][name]).all() for name in ALL)
        for kind, got, want in zip(KINDS, gradient, found[0][1], strict=True):
            if kind != "friction":  # nothing rubs, and a reversed run does not know by how much it would
                np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max(), err_msg=kind)


def momenta(rollout):
    """Return the momentum of all nodes (T + 1, D), and the angular momentum about the origin, at control steps."""
    model, m = rollout.model, rollout.bundle.nodes.mass
    X, states, found = rollout.rest.patches.positions(model.dx), rollout.start[None].copy(), []
    for control in range(model.n_controls + 1):
        u, p = states[0, 0, : len(m), : model.dim], m[:, None] * states[0, 1, : len(m), : model.dim]
        found.append((p.sum(axis=0), turned(X + u, p)))
        if control < model.n_controls:
            rollout.advance(control * model.substeps, (control + 1) * model.substeps, states, keep=False)
    linear, angular = zip(*found, strict=True)
    return np.array(linear), np.array(angular)


def assert_momentum_is_balanced(model, inputs, rollout):
    """Assert that reactions and loads change the momentum of all bodies."""
    linear, _ = momenta(rollout)
    records, step, load = rollout.read_records(), model.substeps * model.dt, inputs.fields.force.sum(axis=0)
    for control in range(model.n_controls):
        forces = sum(rows[control + 1, : model.dim] for rows in records.held.values())
        change = (linear[control + 1] - linear[control]) / step
        np.testing.assert_allclose(change, forces + load, rtol=0, atol=1e-11 * np.abs(forces).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_the_momentum_of_all_bodies_changes_by_reactions_and_loads(dim):
    """To rounding. Cables and springs act between particles, and body forces are off."""
    model, inputs = recorded(dim, viscous=False)
    inputs.fields.damping[:], inputs.strength[:] = 0.0, 0.0
    rollout = make_rollout(*compiled(model, inputs, viscous=False))
    assert_momentum_is_balanced(model, inputs, rollout)


def turned(x, p):
    """Return the angular momentum about the origin (1,) or (3,)."""
    return np.atleast_1d(total_lagrangian.turning(x, p).sum(axis=0))


def test_the_angular_momentum_changes_by_the_moments():
    """Moments of clamps are about their own centre, and count about the origin here; loads are off.

    Friction between bodies would add to it: it acts on a point and on a facet, which are a depth apart.
    """
    model, inputs = meets_smoothly(*recorded(2, viscous=False))
    inputs.fields.damping[:], inputs.fields.force[:], inputs.strength[:] = 0.0, 0.0, 0.0
    rollout = make_rollout(*compiled(model, inputs, viscous=False))
    (reactions,) = rollout.reactions
    X, centres = rollout.rest.patches.positions(model.dx), {}
    for k, name in enumerate(model.reactions):
        own = reactions.node[reactions.owner == k]
        centres[name] = X[own].mean(axis=0) if len(own) else np.zeros(2)
    _, angular = momenta(rollout)
    records, step = rollout.read_records(), model.substeps * model.dt
    for control in range(model.n_controls):
        moments = [
            rows[control + 1, 2] + turned(centres[name][None], rows[control + 1, None, :2])[0]
            for name, rows in records.held.items()
        ]
        change = (angular[control + 1, 0] - angular[control, 0]) / step
        assert change == pytest.approx(sum(moments), abs=1e-11 * np.abs(moments).max())


@needs_jit
@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_any_number_of_threads_gives_the_same_bits(precision):
    model, inputs = recorded(2, real=precision)
    found = []
    for threads in (1, 2, 3):
        rollout = make_rollout(model, inputs, threads=threads, adjoint=True)
        records, bar = rollout.gradient(lambda records, state: LossBar(bar_of(model)))
        assert rollout.threads == threads
        found.append([a.tobytes() for a in (*records.held.values(), *arrays(bar))])
    assert found[0] == found[1] == found[2]


def test_single_precision_gives_the_same_but_for_rounding():
    found = []
    for precision in (np.float64, np.float32):
        model, inputs = recorded(2, real=precision)
        rollout = make_rollout(model, inputs, adjoint=True)
        loss_bar_ = LossBar(bar_of(model))
        records, bar = rollout.gradient(lambda records, state, bar=loss_bar_: bar)
        found.append([*records.held.values(), *arrays(bar)])
    for got, want in zip(*found, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=2e-3 * np.abs(want).max())


def test_the_motion_and_its_gradient_do_not_feel_that_reactions_are_recorded():
    """But for rounding: the kernels with reactions are others, and the compiler fuses other sums."""
    found = []
    for reactions in (ALL, ()):
        model, inputs = touched(2)
        model = replace(model, reactions=reactions)
        of_probe = LossBar(random_records(Records.zeros(model.n_controls, 3, 2), np.random.default_rng(1)))
        records, bar = make_rollout(model, inputs, adjoint=True).gradient(lambda records, state, bar=of_probe: bar)
        assert set(records.held) == set(reactions)
        found.append([*parts(records), *arrays(bar)])
    for got, want in zip(*found, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())


def loss(records):
    """Return a curved loss of all reactions."""
    return sum(np.sin(a).sum() + 0.5 * (a**2).sum() for a in records.held.values())


def loss_bar(records, _):
    bar = records.zeros_like()
    bar.held = {name: np.cos(a) + a for name, a in records.held.items()}
    return LossBar(bar)


@pytest.mark.parametrize("kind", ["v", "fixed_corotated.E", "friction", "force"])
def test_taylor_remainder_is_of_second_order(kind, rng):
    model, inputs = touched(2, viscous=False, substeps=8, seed=4)
    model = replace(model, reactions=ALL)
    records, bar = make_rollout(*compiled(model, inputs, viscous=False), adjoint=True).gradient(loss_bar)
    change, here = direction(inputs, kind, rng), loss(records)
    slope = (arrays(completed(bar, viscous=False))[KINDS.index(kind)] * change).sum()
    remainders = [
        abs(loss(make_rollout(*compiled(model, moved(inputs, kind, h * change), False)).run()) - here - h * slope)
        for h in STEPS[4:14]
    ]
    assert np.log2(remainders[-6] / remainders[-1]) / 5 >= 1.9, remainders


def carrying(dim, viscous=False):
    """Return a model whose clamp moves and turns while bodies touch obstacles, its inputs, and the clamp's number."""
    model, inputs = meets_smoothly(*recorded(dim, viscous=viscous))
    turns = 1 if dim == 2 else 3
    spec = Sticky(face="x_min", displacement=[0.0] * dim, rotation=[0.0] * turns)
    k = next(k for k, c in enumerate(model.conditions) if isinstance(c.spec, Sticky))
    conditions = tuple(replace(c, spec=spec) if j == k else c for j, c in enumerate(model.conditions))
    inputs.moves = np.zeros((len(conditions), dim + turns))
    inputs.moves[k] = 0.02 * np.random.default_rng(5).normal(size=dim + turns)
    return replace(smooth(model), conditions=conditions), inputs, k


@pytest.mark.parametrize(("dim", "reversible"), [(2, True), (2, False), (3, True)])
def test_reactions_of_a_clamp_that_moves(dim, reversible, rng):
    """By differences, because the equations in plain NumPy know no clamp that moves."""
    model, inputs, k = carrying(dim)
    bar = bar_of(model)
    rollout = make_rollout(*compiled(model, inputs, False), adjoint=True)
    rollout.reversible = reversible
    _, inputs_bar = rollout.gradient(lambda records, state: LossBar(bar))
    assert rollout.plan.backwards == reversible

    def difference(inputs_at):
        ends = [
            product(make_rollout(*compiled(model, inputs_at(1e-4 * sign), False)).run(), bar) for sign in (-2, -1, 1, 2)
        ]
        return (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-4

    for axis in range(inputs.moves.shape[1]):

        def carried_farther(h, axis=axis):
            other = copy.deepcopy(inputs)
            other.moves[k, axis] += h
            return other

        assert inputs_bar.moves[k, axis] == pytest.approx(difference(carried_farther), rel=1e-6)
    for kind in ("mass", "fixed_corotated.E", "damping"):
        change = direction(inputs, kind, rng)
        slope = (arrays(completed(copy.copy(inputs_bar), False))[KINDS.index(kind)] * change).sum()
        assert slope == pytest.approx(difference(lambda h, k=kind, c=change: moved(inputs, k, h * c)), rel=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_clamp_that_moves_balances_the_momentum(dim):
    model, inputs, _ = carrying(dim)
    inputs.fields.damping[:], inputs.strength[:] = 0.0, 0.0
    rollout = make_rollout(*compiled(model, inputs, viscous=False))
    assert_momentum_is_balanced(model, inputs, rollout)

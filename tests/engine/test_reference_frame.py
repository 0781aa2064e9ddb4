"""The reference frame: its motion against the equations in plain NumPy, its adjoint, and what it conserves."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import total_lagrangian
from little_worlds import STRESSES, TERMS, cases, needs_jit, world
from rich_scene import KINDS, arrays, direction, moved, parts, product, random_records, random_state, rebuilt, rich
from scipy.spatial.transform import Rotation

from cqrun.boundaries.slip import Slip
from cqrun.boundaries.sticky import Sticky
from cqrun.engine.frames import make_rollout
from cqrun.engine.lattice import Lattice
from cqrun.engine.model import GroupModel, LossBar, Records
from cqrun.engine.reference.ghost import THIRD
from cqrun.engine.reference.moves import rotation_matrix
from cqrun.engine.reference.stretch import LEAST
from cqrun.errors import RolloutError
from cqrun.materials.lame import shear_modulus
from cqrun.materials.term import MaterialTerm

DOT_PRODUCT = 1e-9
TINY = 1e-30
ELASTIC = (TERMS[0], TERMS[1], TERMS[3])
"""The terms that do not depend on rates."""

SHEAR = (shear_modulus, shear_modulus, MaterialTerm.shear_modulus, MaterialTerm.shear_modulus)
"""The shear modulus of each of TERMS."""

SLOW = {"viscosity.shear", "viscosity.bulk"}
UNKNOWN = {"F", "friction"}
"""What a rollout in this frame has no gradient of."""


def held(dim, *, viscous=True, seed=0, **options):
    """Return a rich model in the reference frame, held by slipping and clamped nodes, and its inputs at rest."""
    model, inputs = rich(dim, seed=seed, **options)
    walls = [c if isinstance(c.spec, (Slip, Sticky)) else replace(c, nodes=np.zeros_like(c.nodes))
             for c in model.conditions]  # fmt: skip
    inputs.state.F[...] = np.eye(dim)
    if not viscous:
        inputs.terms[0][2][...] = 0.0
    groups = (replace(model.groups[0], shear=SHEAR),)
    return replace(model, conditions=tuple(walls), groups=groups, frame="reference"), inputs


def split(model, inputs, spacing=0.0):
    """Return a model whose particles hang together if they are 1.75 spacings apart; all of them for a spacing of 0."""
    return replace(model, lattice=Lattice(inputs.state.x.copy(), np.full(2, spacing)))


def compiled(model, inputs, viscous):
    """Return the engine's model and inputs: without the viscous term, a rollout runs backwards."""
    if viscous:
        return model, inputs
    given = copy.copy(inputs)
    given.terms = [[inputs.terms[0][k] for k in (0, 1, 3)]]
    shear = (SHEAR[0], SHEAR[1], SHEAR[3])
    return replace(model, groups=(GroupModel((0, 1), ELASTIC, STRESSES, shear=shear),)), given


def completed(bar, viscous):
    """Return the cotangent of inputs with a zero in place of the viscous term."""
    if not viscous:
        first, second, last = bar.terms[0]
        bar.terms = [[first, second, np.zeros_like(first), last]]
    return bar


CASES = {
    "2D": (2, True, False), "2D reversed": (2, False, False), "3D": (3, True, False), "3D reversed": (3, False, False),
    "2D means": (2, True, True), "2D means, reversed": (2, False, True), "3D means, reversed": (3, False, True),
    "2D split": (2, True, False, 0.06), "3D split, means, reversed": (3, False, True, 0.08),
}  # fmt: skip
"""Name -> dimension, whether the material is viscous, whether volumes are averaged, and the lattice's spacing."""


FAST = ("2D reversed", "3D", "2D means", "2D split", "3D split, means, reversed")
"""Cases in which each pair of choices occurs."""


@pytest.fixture(scope="module", params=cases(CASES, FAST))
def case(request):
    """Return a model, its inputs, cotangents, the rollout and its gradient."""
    dim, viscous, averaged, *spacing = request.param
    rng = np.random.default_rng(7)
    model, inputs = held(dim, viscous=viscous)
    model, inputs.shaped = replace(split(model, inputs, *spacing), averaged=averaged), True
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim), rng)
    state_bar = random_state(inputs.state, rng)
    rollout = make_rollout(*compiled(model, inputs, viscous), adjoint=True)
    records, bar = rollout.gradient(lambda records, state: LossBar(records_bar, state_bar))
    assert rollout.reversible == (not viscous)
    assert bool(len(rollout.rest.patches.split)) == bool(spacing)
    return model, inputs, records_bar, state_bar, rollout, records, completed(bar, viscous), viscous


def test_the_motion_is_that_of_the_equations(case):
    model, inputs, _, _, rollout, records, _, _ = case
    expected, last = total_lagrangian.rollout(model, inputs)
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())
    for got, want in zip(parts(rollout.unpack(rollout.final, 0)), parts(last), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in UNKNOWN])
def test_dot_product(case, kind, rng):
    model, inputs, records_bar, state_bar, _, _, bar, viscous = case
    if kind in SLOW and not viscous:
        pytest.skip("this material has no viscosity")
    change = direction(inputs, kind, rng)
    records, last = total_lagrangian.rollout(model, moved(inputs, kind, 1j * TINY * change))
    forward = (product(records, records_bar) + product(last, state_bar)).imag / TINY
    backward = (arrays(bar)[KINDS.index(kind)] * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


THREADED = [(True, 0.0, True, np.float64), (False, 0.0, False, np.float64), (True, 0.06, False, np.float32)]
"""Whether volumes are averaged, the lattice's spacing, whether the material is viscous, and the precision."""


@needs_jit
@pytest.mark.parametrize(("averaged", "spacing", "viscous", "precision"), THREADED)
def test_any_number_of_threads_gives_the_same_bits(averaged, spacing, viscous, precision):
    model, inputs = held(2, viscous=viscous, real=precision)
    model, inputs.shaped = replace(split(model, inputs, spacing), averaged=averaged), averaged
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2), np.random.default_rng(1))
    found = []
    for threads in (1, 2, 3):
        rollout = make_rollout(*compiled(model, inputs, viscous), threads=threads, adjoint=True)
        records, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        assert rollout.threads == threads
        found.append([a.tobytes() for a in (*parts(records), *arrays(completed(bar, viscous)))])
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(
    ("dim", "averaged", "spacing"),
    [(2, False, 0.0), (3, False, 0.0), (2, True, 0.0), (2, True, 0.06)],
    ids=["2D", "3D", "averaged", "split"],
)
def test_a_reversed_gradient_is_that_of_kept_states(dim, averaged, spacing):
    model, inputs = compiled(*held(dim, viscous=False, substeps=8, controls=3), viscous=False)
    model, inputs.shaped = replace(split(model, inputs, spacing), averaged=averaged), True
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim), np.random.default_rng(2))
    gradients = []
    for reversible in (True, False):
        rollout = make_rollout(model, inputs, adjoint=True)
        assert rollout.reversible
        rollout.reversible = reversible
        _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        gradients.append(arrays(completed(bar, viscous=False)))
        assert rollout.plan is not None
    for got, want in zip(*gradients, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())


def test_a_reversed_run_starts_again_from_kept_states(monkeypatch):
    """Strong damping grows backwards, so states are kept; without memory for them, a gradient keeps checkpoints."""
    model, inputs = compiled(*held(2, viscous=False, substeps=8, controls=4), viscous=False)
    inputs.fields.damping[:] = 15.0 / (10 * model.dt)
    rollout = make_rollout(model, inputs, adjoint=True)
    few = 5 * rollout.start.nbytes
    monkeypatch.setattr("cqrun.engine.reference.rollout.SNAPSHOTS", few)
    assert not make_rollout(model, inputs, adjoint=True).reversible
    monkeypatch.setattr("cqrun.engine.reference.rollout.SNAPSHOTS", 2 * few)
    fresh = make_rollout(model, inputs, adjoint=True)
    assert fresh.reversible
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2), np.random.default_rng(2))
    _, bar = fresh.gradient(lambda records, state: LossBar(records_bar))
    assert fresh.plan.n_chunks > 1
    assert fresh.plan.chunk <= 10
    rollout.reversible = False
    _, kept = rollout.gradient(lambda records, state: LossBar(records_bar))
    for got, want in zip(*(arrays(completed(b, viscous=False)) for b in (bar, kept)), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())


def test_planes_at_an_acute_angle_keep_a_run_from_being_reversed():
    model, inputs = compiled(*held(2, viscous=False), viscous=False)
    slips = [k for k, c in enumerate(model.conditions) if isinstance(c.spec, Slip)]
    oblique = tuple(np.array([1.0, 1.0]) / np.sqrt(2))
    nodes = model.conditions[slips[0]].nodes
    changed = [replace(c, nodes=nodes, normal=oblique) if k == slips[1] else c for k, c in enumerate(model.conditions)]
    assert not make_rollout(replace(model, conditions=tuple(changed)), inputs, adjoint=True).reversible


STEPS = 2.0 ** -np.arange(2, 20)


def loss(records):
    """Return a loss that is curved in all that is recorded."""
    return float(sum(np.sin(a).sum() + 0.5 * (a**2).sum() for a in parts(records)))


@pytest.mark.parametrize(
    "kind", ["x", "v", "mass", "fixed_corotated.E", "neo_hookean.nu", "muscle.activation", "force"]
)
@pytest.mark.parametrize(
    ("viscous", "averaged", "spacing"),
    [(True, False, 0.0), (False, False, 0.0), (False, True, 0.0), (False, True, 0.06)],
    ids=["viscous", "elastic", "averaged", "split"],
)
def test_taylor_remainder_is_of_second_order(viscous, averaged, spacing, kind, rng):
    model, inputs = held(2, viscous=viscous, substeps=8, controls=3, seed=4)
    model, inputs.shaped = replace(split(model, inputs, spacing), averaged=averaged), True

    def loss_bar(records, _):
        return LossBar(rebuilt(records, [np.cos(a) + a for a in parts(records)]))

    records, bar = make_rollout(*compiled(model, inputs, viscous), adjoint=True).gradient(loss_bar)
    change, here = direction(inputs, kind, rng), loss(records)
    slope = (arrays(completed(bar, viscous))[KINDS.index(kind)] * change).sum()
    remainders = [
        abs(loss(make_rollout(*compiled(model, moved(inputs, kind, h * change), viscous)).run()) - here - h * slope)
        for h in STEPS[:8]
    ]
    assert max(np.log2(np.array(remainders[:-1]) / remainders[1:])[-4:]) >= 1.9, remainders
    assert np.log2(remainders[-5] / remainders[-1]) / 4 >= 1.9, remainders


# --- what it conserves ----------------------------------------------------------------------------------------------


def free_block(dim, *, turn=5.0, seconds=1.0, dt=1e-4, controls=5):
    """Return a free elastic block of 4 x 3 (x 2) cells that turns, in the reference frame, and its inputs."""
    dx, counts = 0.1, (8, 6, 4)[:dim]
    axes = [0.525 + 0.05 * np.arange(count) for count in counts]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, dim)
    n = len(x)
    substeps = round(seconds / (controls * dt))
    model, inputs = world(x, size=[2.0] * dim, dx=dx, dt=dt, substeps=substeps, controls=controls,
                          mass=1000 * 0.05**dim, volume=0.05**dim, E=1e5, nu=0.3, probe=np.eye(n))  # fmt: skip
    A = np.zeros((dim, dim))
    A[0, 1], A[1, 0] = -turn, turn
    inputs.state.v[:] = (x - x.mean(axis=0)) @ A.T
    inputs.state.C[:] = A
    model = replace(model, frame="reference", groups=(GroupModel((0,), (TERMS[0],), shear=SHEAR[:1]),))
    inputs.terms = [[inputs.terms[0][0]]]
    return model, inputs


@pytest.mark.parametrize("dim", [2, 3])
def test_a_free_block_keeps_its_angular_momentum_to_rounding(dim):
    """Sum over nodes of (X + u) x m v: P F^T is symmetric and the weights reproduce X, so no moment arises."""
    model, inputs = free_block(dim, seconds=0.2)
    rollout = make_rollout(model, inputs)
    X, m = rollout.rest.patches.positions(model.dx), rollout.bundle.nodes.mass[:, None]

    def momenta(q):
        y, p = X + q[0][:, :dim], m * q[1][:, :dim]
        return p.sum(axis=0), y[:, :1].T @ p[:, 1:] - p[:, :1].T @ y[:, 1:]

    before = momenta(rollout.start)
    rollout.run()
    after = momenta(rollout.final)
    size = np.abs(before[1]).max()
    np.testing.assert_allclose(after[1], before[1], rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(after[0], before[0], rtol=0, atol=1e-12 * size)


def test_a_bar_that_turns_keeps_its_length():
    """In the other frame, positions creep away from F (tests/running/test_drift.py)."""
    model, inputs = free_block(2, turn=2 * np.pi, seconds=2.0)
    records = make_rollout(model, inputs).run()
    pairs = np.abs(inputs.state.x[:, 0] - inputs.state.x[:, 0].min()) < 1e-9
    ends = np.flatnonzero(pairs), np.flatnonzero(inputs.state.x[:, 0] == inputs.state.x[:, 0].max())
    length = [np.linalg.norm(x[ends[1]].mean(axis=0) - x[ends[0]].mean(axis=0)) for x in records.x]
    theory = 1 + 1000 * (2 * np.pi) ** 2 * (0.35 / 2) ** 2 / (2 * 1e5)  # rho w^2 L^2 / (8 E), and it swings about that
    assert max(length) / length[0] - 1 < 4 * (theory - 1) + 0.005
    stretch = np.linalg.norm(records.F[:, :, :, 0], axis=2).mean(axis=1)
    np.testing.assert_allclose(np.array(length) / length[0], stretch, rtol=3e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_energy_does_not_drift(dim):
    """Energy of a symplectic step, with the velocity at the time of the displacement, in a lively motion."""
    model, inputs = free_block(dim, turn=1.0, seconds=1.0, controls=40)
    inputs.state.v[:, 0] += 2.0 * (inputs.state.x[:, 0] - inputs.state.x[:, 0].mean())
    inputs.state.C[:, 0, 0] += 2.0
    rollout = make_rollout(model, inputs)
    states, totals = rollout.start[None].copy(), []
    m, mu, lam = rollout.bundle.nodes.mass[:, None], 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4)
    for k in range(model.n_controls):
        rollout.advance(k * model.substeps, (k + 1) * model.substeps - 1, states, keep=False)
        F, u, before = rollout.unpack(states[0], k).F, states[0, 0].copy(), states[0, 1].copy()
        rollout.advance((k + 1) * model.substeps - 1, (k + 1) * model.substeps, states, keep=False)
        v = 0.5 * (before + states[0, 1])  # a step's velocity belongs to the middle between two displacements
        values, J = np.linalg.svd(F)[1], np.linalg.det(F)
        W = mu * ((values - 1) ** 2).sum(axis=1) + lam / 2 * (J - 1) ** 2
        difference = np.einsum("k,rkd->rd", THIRD, u[rollout.runs.run])
        penalty = 0.5 * rollout.ghosts[0].scale @ (difference**2).sum(axis=1)
        totals.append(0.5 * (m * v**2).sum() + 0.05**dim * W.sum() + penalty)
    assert np.ptp(totals) < 1e-4 * np.mean(totals)
    assert abs(np.mean(totals[20:]) / np.mean(totals[:20]) - 1) < 1e-5


def test_a_motion_that_blows_up_is_reported():
    model, inputs = free_block(2, turn=1.0, seconds=0.5, dt=5e-2)
    with pytest.raises(RolloutError, match="not finite") as raised, np.errstate(all="ignore"):
        make_rollout(model, inputs).run()
    assert raised.value.body == "body 0"


# --- boundaries that move ---------------------------------------------------------------------------------------------


def carried(dim, viscous=False, over=None, **options):
    """Return a rich model whose clamp moves and turns, and its inputs."""
    model, inputs = held(dim, viscous=viscous, **options)
    turns = 1 if dim == 2 else 3
    spec = Sticky(face="x_min", displacement=[0.0] * dim, rotation=[0.0] * turns, over=over)
    conditions = [
        replace(c, spec=spec) if isinstance(c.spec, Sticky) and c.nodes.any() else c for c in model.conditions
    ]
    rng = np.random.default_rng(5)
    inputs.moves = np.zeros((len(conditions), dim + turns))
    k = next(k for k, c in enumerate(conditions) if c.spec is spec)
    inputs.moves[k] = 0.02 * rng.normal(size=dim + turns)
    return replace(model, conditions=tuple(conditions)), inputs, k


@pytest.mark.parametrize("viscous", [True, False], ids=["viscous", "reversed"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_clamp_that_moves_takes_its_particles_along(dim, viscous):
    """After the run, the nodes are where displacement and rotation put them; the momentum it gives has a gradient."""
    model, inputs, k = carried(dim, viscous)
    rng = np.random.default_rng(8)
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim), rng)
    given = compiled(model, inputs, viscous)
    rollout = make_rollout(*given, adjoint=True)
    _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
    (moves,) = rollout.moves
    d, theta = inputs.moves[k, :dim], inputs.moves[k, dim:]
    R = Rotation.from_rotvec(np.append([0.0, 0.0], theta) if dim == 2 else theta).as_matrix()[:dim, :dim]
    there = d + moves.arm @ (R - np.eye(dim)).T
    np.testing.assert_allclose(rollout.final[0][moves.nodes, :dim], there, rtol=0, atol=1e-15)
    for axis in range(inputs.moves.shape[1]):
        ends = []
        for sign in (-2, -1, 1, 2):
            moved_inputs = copy.copy(given[1])
            moved_inputs.moves = inputs.moves.copy()
            moved_inputs.moves[k, axis] += sign * 1e-4
            ends.append(product(make_rollout(model if viscous else given[0], moved_inputs).run(), records_bar))
        difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-4
        assert bar.moves[k, axis] == pytest.approx(difference, rel=1e-7)
    assert not bar.moves[np.arange(len(bar.moves)) != k].any()


@pytest.mark.parametrize("kind", ["mass", "fixed_corotated.E", "damping", "force"])
def test_other_gradients_hold_beside_a_clamp_that_moves(kind, rng):
    """By differences, because the equations in plain NumPy know no clamp that moves; both ways of going back."""
    model, inputs, _ = carried(2, over=0.02)
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2), np.random.default_rng(8))
    change = direction(inputs, kind, rng)
    for reverses in (True, False):
        rollout = make_rollout(*compiled(model, inputs, False), adjoint=True)
        rollout.reversible = reverses
        _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        slope = (arrays(completed(bar, False))[KINDS.index(kind)] * change).sum()
        near = [moved(inputs, kind, h * 1e-4 * change) for h in (-2, -1, 1, 2)]
        ends = [product(make_rollout(*compiled(model, there, False)).run(), records_bar) for there in near]
        assert slope == pytest.approx((ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-4, rel=1e-7)


def test_a_rotation_and_its_slope(rng):
    for theta in (np.zeros(3), 1e-5 * rng.normal(size=3), rng.normal(size=3)):
        R = np.eye(3) + rotation_matrix(theta)
        np.testing.assert_allclose(R, Rotation.from_rotvec(theta).as_matrix(), rtol=0, atol=1e-14)
        slope = np.imag(rotation_matrix(theta + 1e-30j * np.array([0, 1, 0]))) / 1e-30
        ends = [Rotation.from_rotvec(theta + h * np.array([0, 1, 0])).as_matrix() for h in (-1e-5, 1e-5)]
        np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2e-5, rtol=0, atol=1e-9)


# --- the substep as bodies stretch ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_the_least_principal_stretch_is_noted(dim):
    model, inputs = free_block(dim, turn=1.0, seconds=0.1, controls=20)
    inputs.state.v[:, 0] -= 8.0 * (inputs.state.x[:, 0] - inputs.state.x[:, 0].mean())
    inputs.state.C[:, 0, 0] -= 8.0
    seen = []
    rollout = make_rollout(model, inputs)
    rollout.run(observe=lambda k, state: seen.append(np.linalg.svd(state.F, compute_uv=False).min()))
    assert min(seen) < 0.9
    least, _, step = rollout.bundle.least[LEAST, :3]
    assert least <= min(seen) * (1 + 1e-9)  # it is looked at between control steps, too
    assert least == pytest.approx(min(seen), rel=0.01)
    assert abs(step - model.substeps * int(np.argmin(seen))) <= model.substeps
    assert rollout.remarks() == []  # the substep is short enough

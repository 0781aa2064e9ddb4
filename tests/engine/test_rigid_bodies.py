"""Rigid bodies in the reference frame: motion against plain NumPy, the adjoint, and what is conserved."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import total_lagrangian
from gripping import Gripping
from little_worlds import needs_jit
from rich_scene import (
    KINDS,
    arrays,
    direction,
    make_complex,
    moved,
    parts,
    product,
    random_records,
    random_state,
    rebuilt,
)
from scipy.spatial.transform import Rotation
from test_contact import ball, compiled, completed, touched
from test_reference_frame import DOT_PRODUCT, STEPS, TINY

from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.reference.reactions import columns
from cqrun.engine.rigid_model import FORCE, FRICTION, INERTIA, MASS, NUMBERS, OFFSET, SPIN, TORQUE, VELOCITY, RigidModel
from cqrun.errors import RigidBodyError

SOFT = ("v", "mass", "force", "fixed_corotated.E", "friction", "cable.rest")
"""The kinds of input of soft bodies whose derivative is compared."""

RIGID = {"offset": OFFSET, "velocity": VELOCITY, "spin": SPIN, "mass": MASS, "inertia": INERTIA, "force": FORCE,
         "torque": TORQUE, "friction": FRICTION}  # fmt: skip

NAMES = ("stone", "wheel", "jaw", "post")
STIFFNESS = {2: 20.0, 3: 1.0}


def numbers(dim, rng):
    """Return the numbers of a rigid body; in 2D it stays in its plane."""
    out = rng.normal(size=NUMBERS)
    out[OFFSET] *= 0.01
    out[VELOCITY] *= 0.3
    out[SPIN] *= 2.0
    out[MASS] = 4e-3 * rng.uniform(0.8, 1.2)
    out[INERTIA] = out[MASS] * 0.07**2 * np.array([0.3, 0.4, 0.55])
    out[FORCE] *= 0.02
    out[TORQUE] *= 1e-4
    out[FRICTION] = 0.5
    if dim == 2:
        out[[2, 5, 15]] = 0.0
        for columns_ in (SPIN, TORQUE):
            out[columns_] *= [0, 0, 1]
        out[INERTIA] = out[INERTIA][1]
    return out


def gripped(dim, *, viscous=True, seed=0, **options):
    """Return a rich model with two free bodies, one that follows a path and one that stays, and its inputs."""
    model, inputs = touched(dim, viscous=viscous, seed=seed, **options)
    rng, e, K = np.random.default_rng(seed + 11), np.eye(dim), STIFFNESS[dim]
    axes = np.eye(3) if dim == 2 else Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()

    def at(x, z):
        return np.array([x, z] if dim == 2 else [x, 0.36, z])

    def balls(center, radius):  # in 3D, in a row along y
        return tuple(ball(center + y * e[1], radius) for y in ((0.0,) if dim == 2 else (-0.08, 0.0, 0.08)))

    def full(a):
        return np.pad(a, (0, 3 - dim))

    def free(name, center, rubs):
        ways = rng.normal(size=(25, dim))
        skin = np.pad(center + 0.075 * ways / np.linalg.norm(ways, axis=1)[:, None], ((0, 0), (0, 3 - dim)))
        solids, k = (*balls(center, 0.075), *balls(center + 0.03 * e[0], 0.06)), K * rng.uniform(0.5, 1.0, 25)
        return RigidModel(name, solids, full(center - 0.01 * e[-1]), 0.2, rubs, 0.4, True, axes=axes, skin=skin,
                          stiffness=k, impedance=2 * k * model.dt)  # fmt: skip

    bodies = (
        free("stone", at(0.2, 0.33), True),
        free("wheel", at(0.55, 0.43), False),
        RigidModel("jaw", balls(at(0.3, 0.48), 0.06), full(at(0.5, 0.5)), 0.4, True, 0.3,
                   times=np.array([3.0, 9.0]) * model.dt),
        RigidModel("post", balls(at(0.42, 0.3), 0.05), full(at(0.42, 0.3)), 0.2, True, 0.0),
    )  # fmt: skip
    inputs.rigid = np.array([numbers(dim, rng) for _ in bodies])
    inputs.rigid[2:, 3:19] = 0.0
    inputs.waypoints = rng.normal(size=(2, 6)) * np.array([0.02, 0.02, 0.02, 0.3, 0.3, 0.3])
    if dim == 2:
        inputs.waypoints[:, 2:5] = 0.0
    return replace(model, rigid=bodies, reactions=("jaw", "stone", model.conditions[0].name)), inputs


def moved_rigid(inputs, name, change):
    """Return inputs with numbers of rigid bodies, or waypoints, moved."""
    other = copy.deepcopy(inputs)
    if np.iscomplexobj(change):
        make_complex(other)
        other.rigid, other.waypoints = other.rigid.astype(complex), other.waypoints.astype(complex)
    if name == "waypoints":
        other.waypoints += change
    else:
        other.rigid[:, RIGID[name]] += change
    return other


def direction_of(inputs, name, dim, rng):
    """Return a random direction of numbers of rigid bodies: zero where they have no such number."""
    value = inputs.waypoints if name == "waypoints" else inputs.rigid[:, RIGID[name]]
    return rng.normal(size=value.shape) * np.abs(value)


def all_of(a, b):
    """Return the scalar product of records, with forces and poses."""
    total = product(a, b)
    for kind in ("held", "rigid"):
        for name, bar in getattr(b, kind).items():
            total = total + (getattr(a, kind)[name] * bar).sum()
    return total


def random_bar(model, inputs, rng):
    """Return random cotangents of the records and of the last state."""
    bar = random_records(Records.zeros(model.n_controls, 3, model.dim), rng)
    steps, reactions = model.n_controls + 1, len(columns(model.dim))
    held = {name: rng.normal(size=(steps, reactions)) for name in model.reactions}
    poses = {body.name: rng.normal(size=(steps, 6 if model.dim == 2 else 12)) for body in model.rigid}
    return replace(bar, held=held, rigid=poses), random_state(inputs.state, rng)


@pytest.fixture(scope="module", params=[(2, True), (2, False), (3, False)], ids=["2D viscous", "2D", "3D"])
def case(request):
    """Return a model, its inputs, cotangents, the rollout and its gradient."""
    dim, viscous = request.param
    model, inputs = gripped(dim, viscous=viscous, seed={2: 0, 3: 9}[dim])
    records_bar, state_bar = random_bar(model, inputs, np.random.default_rng(7))
    rollout = make_rollout(*compiled(model, inputs, viscous), adjoint=True)
    records, bar = rollout.gradient(lambda records, state: LossBar(records_bar, state_bar))
    return model, inputs, records_bar, state_bar, rollout, records, completed(bar, viscous), viscous


def test_the_motion_is_that_of_the_equations(case):
    """Soft points and skins do everything that a point can do, on each kind of rigid body."""
    model, inputs, _, _, rollout, records, _, _ = case
    seen: list[Gripping] = []
    expected, last = total_lagrangian.rollout(model, inputs, watch=lambda touching, _: seen.append(touching))
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())
    for kind in ("held", "rigid"):
        for name, want in getattr(expected, kind).items():
            got = getattr(records, kind)[name]
            assert np.abs(want).max() > 0
            np.testing.assert_allclose(got, want.real, rtol=0, atol=1e-10 * np.abs(want).max(), err_msg=name)
    for got, want in zip(parts(rollout.unpack(rollout.final, 0)), parts(last), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())
    branches = set.union(*seen[0].branches)
    assert {k for k, what in branches if what == "presses"} >= set(range(4, 8)), branches
    assert {"leaves", "sticks", "slides"} <= {what for k, what in branches if k >= 4}, branches
    assert {"skin presses", "skin sticks", "skin slides"} <= {what for _, what in branches}, branches


@pytest.mark.parametrize("name", [*RIGID, "waypoints"])
def test_dot_product_of_rigid_bodies(case, name, rng):
    model, inputs, records_bar, state_bar, _, _, bar, _ = case
    change = direction_of(inputs, name, model.dim, rng)
    records, last = total_lagrangian.rollout(model, moved_rigid(inputs, name, 1j * TINY * change))
    forward = (all_of(records, records_bar) + product(last, state_bar)).imag / TINY
    backward = ((bar.waypoints if name == "waypoints" else bar.rigid[:, RIGID[name]]) * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.parametrize("kind", SOFT)
def test_dot_product_of_soft_bodies(case, kind, rng):
    model, inputs, records_bar, state_bar, _, _, bar, _ = case
    change = direction(inputs, kind, rng)
    shifted = moved(inputs, kind, 1j * TINY * change)
    shifted.rigid, shifted.waypoints = inputs.rigid.astype(complex), inputs.waypoints.astype(complex)
    records, last = total_lagrangian.rollout(model, shifted)
    forward = (all_of(records, records_bar) + product(last, state_bar)).imag / TINY
    backward = (arrays(bar)[KINDS.index(kind)] * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


@needs_jit
def test_any_number_of_threads_gives_the_same_bits():
    model, inputs = gripped(2)
    records_bar, _ = random_bar(model, inputs, np.random.default_rng(1))
    found = []
    for threads in (1, 2, 3):
        rollout = make_rollout(model, inputs, threads=threads, adjoint=True)
        records, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        assert rollout.threads == threads
        more = (*records.held.values(), *records.rigid.values(), bar.rigid, bar.waypoints)
        found.append([a.tobytes() for a in (*parts(records), *arrays(bar), *more)])
    assert found[0] == found[1] == found[2]


def test_checkpoints_carry_free_bodies():
    """Memory for few states gives the gradient that memory for all of them gives."""
    model, inputs = gripped(2, viscous=False, substeps=20)
    model, inputs = compiled(replace(model, dt=model.dt / 5), inputs, viscous=False)
    records_bar, _ = random_bar(model, inputs, np.random.default_rng(2))
    gradients = []
    for budget in (2**30, 20 * make_rollout(model, inputs).start.nbytes):
        rollout = make_rollout(replace(model, memory_budget=budget, spare=[]), inputs, adjoint=True)
        _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        gradients.append([*arrays(completed(bar, False)), bar.rigid, bar.waypoints])
    assert rollout.plan.n_chunks > 1
    for got, want in zip(*gradients, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * np.abs(want).max())


def carried(dim, **options):
    """Return a model without free bodies, friction and dashpots, whose runs can be reversed, and its inputs."""
    model, inputs = gripped(dim, viscous=False, **options)
    bodies = tuple(replace(body, rubs=False, dashpot=0.0) for body in model.rigid[2:])
    inputs.rigid = inputs.rigid[2:]
    inputs.coefficients = inputs.coefficients[:-1]
    return replace(model, rigid=bodies, reactions=("jaw",), obstacles=(), meeting=None), inputs


def test_paths_without_friction_are_reversed():
    model, inputs = carried(2)
    model, inputs = compiled(model, inputs, viscous=False)
    records_bar, _ = random_bar(model, inputs, np.random.default_rng(2))
    gradients = []
    for reversible in (True, False):
        rollout = make_rollout(model, inputs, adjoint=True)
        assert rollout.reversible
        rollout.reversible = reversible
        _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        gradients.append([*arrays(completed(bar, False)), bar.rigid, bar.waypoints])
    assert np.abs(gradients[0][-1]).max() > 0
    for got, want in zip(*gradients, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())


@pytest.mark.parametrize("name", ["velocity", "mass", "friction", "waypoints"])
def test_taylor_remainder_is_of_second_order(name, rng):
    model, inputs = gripped(2, viscous=False)

    def loss(records):
        numbers_ = [*parts(records), *records.held.values(), *records.rigid.values()]
        return sum((np.sin(a) + a**2 / 2).sum() for a in numbers_)

    def loss_bar(records, _):
        slope = [np.cos(a) + a for a in parts(records)]
        held, poses = ({k: np.cos(a) + a for k, a in of.items()} for of in (records.held, records.rigid))
        return LossBar(replace(rebuilt(records, slope), held=held, rigid=poses))

    def run(given):
        return make_rollout(*compiled(model, given, False)).run()

    records, bar = make_rollout(*compiled(model, inputs, viscous=False), adjoint=True).gradient(loss_bar)
    change, here = direction_of(inputs, name, 2, rng), loss(records)
    slope = ((bar.waypoints if name == "waypoints" else bar.rigid[:, RIGID[name]]) * change).sum()
    remainders = [abs(loss(run(moved_rigid(inputs, name, h * change))) - here - h * slope) for h in STEPS[4:14]]
    assert np.log2(remainders[-6] / remainders[-1]) / 5 >= 1.9, remainders


# --- what is conserved -----------------------------------------------------------------------------------------------


def momenta(model, inputs, rollout, q):
    """Return momentum and angular momentum about the origin of nodes and free bodies in a state, (6,)."""
    dim, patches = model.dim, rollout.rest.patches
    mass, X = rollout.bundle.nodes.mass, patches.positions(model.dx)
    x, p = X + q[0, : len(X), :dim], mass[:, None] * q[1, : len(X), :dim]
    x, p = (np.pad(a, ((0, 0), (0, 3 - dim))) for a in (x, p))
    total = np.concatenate([p.sum(axis=0), np.cross(x, p).sum(axis=0)])
    (rigid,) = rollout.contacts.obstacles[0].rigid
    for b, row in enumerate(rigid.row):
        if row >= 0:
            c, p, L = rigid.center[b] + q[0, row, :3], q[1, row, :3], q[1, row + 1, :3]
            total += np.concatenate([p, np.cross(c, p) + L])
    return total


@pytest.mark.parametrize("dim", [2, 3])
def test_soft_and_rigid_bodies_exchange_momentum_exactly(dim):
    """Nothing else acts: no boundaries, loads, bodies on paths or meeting bodies."""
    model, inputs = gripped(dim, viscous=False, seed={2: 0, 3: 9}[dim])
    inputs.rigid, inputs.waypoints = inputs.rigid[:2], inputs.waypoints[:0]
    inputs.rigid[:, FORCE], inputs.rigid[:, TORQUE], inputs.fields.force[:] = 0.0, 0.0, 0.0
    inputs.fields.damping[:], inputs.strength[:] = 0.0, 0.0
    still = tuple(replace(c, nodes=np.zeros_like(c.nodes)) for c in model.conditions)
    model = replace(model, rigid=model.rigid[:2], obstacles=(), meeting=None, conditions=still, reactions=("stone",))
    rollout = make_rollout(*compiled(model, inputs, viscous=False))
    records = rollout.run()
    before, after = (momenta(model, inputs, rollout, q) for q in (rollout.start, rollout.final))
    (rigid,) = rollout.contacts.obstacles[0].rigid
    exchanged = np.abs(rollout.final[1, rigid.row[0]] - rollout.start[1, rigid.row[0]]).max()
    assert np.abs(records.held["stone"]).max() > 0
    assert exchanged > 1e-4
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-13 * np.abs(before).max())


def flying(**numbers_of):
    """Return a model with one free body in 3D that touches nothing, and its inputs, for 2 s in 400 substeps."""
    model, inputs = gripped(3, viscous=False, substeps=100, controls=4)
    far = np.full(3, 50.0)
    body = replace(model.rigid[0], solids=(ball(far, 0.1),), center=far, skin=far + np.zeros((1, 3)),
                   stiffness=np.ones(1), impedance=np.zeros(1), radius=0.1)  # fmt: skip
    inputs.rigid, inputs.waypoints = np.zeros((1, NUMBERS)), inputs.waypoints[:0]
    inputs.rigid[0, MASS], inputs.rigid[0, INERTIA] = 2.0, [0.02, 0.03, 0.05]
    for name, value in numbers_of.items():
        inputs.rigid[0, RIGID[name]] = value
    return replace(model, rigid=(body,), obstacles=(), meeting=None, reactions=()), inputs


def test_free_flight_is_exact():
    model, inputs = flying(velocity=[1.0, 2.0, 3.0], force=[0.0, 1.0, -19.62])
    rows = make_rollout(*compiled(model, inputs, viscous=False)).run().rigid["stone"]
    t = np.arange(5)[:, None] * model.substeps * model.dt
    a = np.array([0.0, 0.5, -9.81])
    np.testing.assert_allclose(rows[:, :3], t * np.array([1.0, 2.0, 3.0]) + t**2 / 2 * a, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(rows[:, 6:9], np.array([1.0, 2.0, 3.0]) + t * a, rtol=1e-13)


@pytest.mark.parametrize(
    "moments", [[0.03, 0.03, 0.03], [0.02, 0.02, 0.05], [0.02, 0.05, 0.05]], ids=["ball", "disc", "rod"]
)
def test_free_spin_of_symmetric_bodies_is_exact(moments):
    """A body with an axis a precesses about L by |L| / I t, and turns about its axis by (1 / I_a - 1 / I) L_a t."""
    spin = np.array([3.0, -2.0, 5.0])
    model, inputs = flying(spin=spin, inertia=moments)
    rows = make_rollout(*compiled(model, inputs, viscous=False)).run().rigid["stone"]
    axes, t = model.rigid[0].axes, 4 * model.substeps * model.dt
    L = axes.T @ (moments * (axes @ spin))
    k = 2 if moments[0] == moments[1] else 0  # the axis of symmetry
    about = (1 / moments[k] - 1 / moments[1]) * (axes[k] @ L) * t
    expected = Rotation.from_rotvec(L / moments[1] * t) * Rotation.from_rotvec(about * axes[k])
    error = (Rotation.from_rotvec(rows[-1, 3:6]) * expected.inv()).magnitude()
    assert error < 1e-12


def test_an_asymmetric_body_keeps_angular_momentum_and_nearly_its_energy():
    """The energy oscillates; four times the substeps leave a sixteenth of it."""
    spin, moments = np.array([1.0, -8.0, 2.0]), np.array([0.02, 0.03, 0.05])
    errors = []
    for substeps in (100, 400):
        model, inputs = flying(spin=spin)
        model = replace(model, substeps=substeps, dt=model.dt * 100 / substeps)
        rollout = make_rollout(*compiled(model, inputs, viscous=False))
        rows = rollout.run().rigid["stone"]
        axes = model.rigid[0].axes
        L = axes.T @ (moments * (axes @ spin))
        row = rollout.contacts.obstacles[0].rigid[0].row[0]
        assert (rollout.final[1, row + 1, :3] == rollout.start[1, row + 1, :3]).all()
        np.testing.assert_allclose(rollout.final[1, row + 1, :3], L, rtol=1e-14)
        energy = rows[:, 9:] @ L / 2
        errors.append(np.abs(energy / energy[0] - 1).max())
    assert errors[0] < 1e-2
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)


def test_a_free_body_inside_another_ends_the_run():
    model, inputs = gripped(2, viscous=False)
    inputs.rigid[0, VELOCITY] = [12.0, 0.0, 0.0]
    with pytest.raises(RigidBodyError, match=r"rigid body 'stone', t = .*: it is inside the rigid body 'wheel'"):
        make_rollout(*compiled(model, inputs, viscous=False)).run()

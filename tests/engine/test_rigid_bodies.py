"""Rigid bodies in the reference frame: motion against plain NumPy, the adjoint, and what is conserved."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import total_lagrangian
from gripping import Gripping
from little_worlds import cases, needs_jit
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
from touching import BODIES

from cqrun.boundaries.sticky import Sticky
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.reference.reactions import columns
from cqrun.engine.rigid_model import FORCE, FRICTION, INERTIA, MASS, NUMBERS, OFFSET, SPIN, TORQUE, VELOCITY, RigidModel

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


@pytest.fixture(scope="module", params=cases(BODIES, ["2D viscous", "3D"]))
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


def test_points_are_found_wherever_a_body_goes():
    """A body that crosses many cells in a control step meets the points that the equations say."""
    model, inputs = carried(2)
    inputs.waypoints[0, :3], inputs.waypoints[1, :3] = [0.0, -0.3, 0.0], [0.4, -0.3, 0.0]
    inputs.waypoints[:, 5] = [1.0, -2.0]
    expected, _ = total_lagrangian.rollout(model, inputs)
    records = make_rollout(*compiled(model, inputs, viscous=False)).run()
    assert (np.abs(expected.held["jaw"]).max(axis=1) > 0).sum() == 2, "it comes, and goes again"
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_a_glued_patch_follows_the_path_of_its_body(dim):
    """Its nodes are where the body's pose puts them, and waypoints have a gradient through them."""
    model, inputs = carried(dim)
    spec = Sticky(face="x_min", to="jaw")
    clamps = [replace(c, spec=spec) if isinstance(c.spec, Sticky) and c.nodes.any() else c for c in model.conditions]
    name = next(c.name for c in clamps if c.spec is spec)
    centers = {name: model.rigid[0].center[:dim]}
    model = replace(model, conditions=tuple(clamps), centers=centers, reactions=("jaw", name))
    inputs.moves, inputs.rigid[:, OFFSET] = np.zeros((len(clamps), 3 if dim == 2 else 6)), 0.0
    records_bar, _ = random_bar(model, inputs, np.random.default_rng(2))

    def run(given):
        return make_rollout(*compiled(model, given, False), adjoint=True)

    rollout = run(inputs)
    records, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
    (moves,) = rollout.moves
    pose = records.rigid["jaw"][-1]
    turn = Rotation.from_rotvec([0.0, 0.0, pose[2]] if dim == 2 else pose[3:6]).as_matrix()[:dim, :dim]
    there = pose[:dim] + moves.arm @ (turn - np.eye(dim)).T
    np.testing.assert_allclose(rollout.final[0][moves.nodes, :dim], there, rtol=0, atol=1e-14)
    for k, axis in [(0, 0), (1, 1), (1, 5)]:
        ends = []
        for sign in (-2, -1, 1, 2):
            change = np.zeros(inputs.waypoints.shape)
            change[k, axis] = sign * 1e-5
            ends.append(all_of(run(moved_rigid(inputs, "waypoints", change)).run(), records_bar))
        difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-5
        assert bar.waypoints[k, axis] == pytest.approx(difference, rel=1e-6)


@needs_jit
def test_paths_in_float32_are_those_of_float64():
    model, inputs = carried(2)
    found = []
    for real in (np.float32, np.float64):
        rollout = make_rollout(*compiled(replace(model, real=real), inputs, viscous=False), adjoint=True)
        records_bar, _ = random_bar(model, inputs, np.random.default_rng(2))
        records, bar = rollout.gradient(lambda records, state, bar=records_bar: LossBar(bar))
        found.append([records.held["jaw"], bar.waypoints])
    for coarse, fine in zip(*found, strict=True):
        np.testing.assert_allclose(coarse, fine, rtol=0, atol=1e-3 * np.abs(fine).max())

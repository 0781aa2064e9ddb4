"""Rigid bodies: what is conserved, free flight and spin, and a block that slides on an incline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_contact import ball, compiled, plane
from test_rigid_bodies import RIGID, gripped

from cqrun.engine.frames import make_rollout
from cqrun.engine.rigid_model import FORCE, INERTIA, MASS, NUMBERS, TORQUE, VELOCITY
from cqrun.engine.surface import ObstacleModel
from cqrun.errors import RigidBodyError


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
    inputs.rigid[0, VELOCITY] = [11.0, 3.1, 0.0]
    with pytest.raises(RigidBodyError, match=r"rigid body 'stone', t = .*: it is inside the rigid body 'jaw'"):
        make_rollout(*compiled(model, inputs, viscous=False)).run()


def test_a_rigid_block_slides_down_an_incline():
    """With g (sin t - mu cos t); four points of its bottom carry it."""
    mu, angle = 0.3, 0.5
    model, inputs = flying()
    g, up, down = 9.81, np.array([-np.sin(angle), 0.0, np.cos(angle)]), np.array([np.cos(angle), 0.0, np.sin(angle)])
    floor = np.array([-50.0, 50.0, -50.0])  # the soft bodies are far above it
    c, K = floor + 0.02 * up, 2e4
    side = np.array([0.0, 1.0, 0.0])
    skin = np.array([c - 0.02 * up + 0.05 * (a * down + b * side) for a in (-1, 1) for b in (-1, 1)])
    body = replace(model.rigid[0], solids=(ball(c, 0.02),), center=c, skin=skin, radius=0.2, axes=np.eye(3),
                   stiffness=np.full(4, K), impedance=np.full(4, 50.0))  # fmt: skip
    incline = ObstacleModel(0, (plane(floor, up),), True, 1.0)
    model = replace(model, rigid=(body,), obstacles=(incline,), substeps=150, n_controls=4, dt=1e-3)
    inputs.activation = np.zeros((4, inputs.activation.shape[1]))
    inputs.coefficients[0], inputs.strength[:], inputs.fields.force[:] = mu, 0.0, 0.0
    inputs.state.v[:], inputs.state.C[:] = 0.0, 0.0  # soft bodies far away, at rest
    inputs.rigid[0, INERTIA] = 2.0 / 12 * np.array([0.01, 0.01, 0.02])
    inputs.rigid[0, FORCE] = [0.0, 0.0, -2.0 * g]
    rows = make_rollout(*compiled(model, inputs, viscous=False)).run().rigid["stone"]
    speed, expected = -rows[:, 6:9] @ down, g * (np.sin(angle) - mu * np.cos(angle))
    assert (speed[-1] - speed[1]) / (3 * 150 * 1e-3) == pytest.approx(expected, rel=5e-3)

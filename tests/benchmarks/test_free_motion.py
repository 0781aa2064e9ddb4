"""Free bodies: falling, flying and turning, where the scheme has exact laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference
from bodies import final, history, lattice
from little_worlds import needs_jit, world

from cqrun.build.assembly import Assembly
from cqrun.build.particles import sample
from cqrun.scene.load import load_scene
from cqrun.state import State

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
DT, DX = 4e-3, 0.1
ROUND_OFF = 1e-13


def jelly(dim: int, rng: np.random.Generator, substeps: int = 50):
    """Return a body with everything that acts from inside it, on a disturbed lattice."""
    x = lattice([0.8] * dim, [0.3] * dim, 0.05)
    x = x + 0.003 * rng.normal(size=x.shape)
    n = len(x)
    return world(
        x, size=[2.0] * dim, dx=DX, dt=DT, substeps=substeps, controls=1, mass=1e-3 * rng.uniform(1, 2, n), volume=1e-3,
        E=rng.uniform(8, 12, n), nu=0.3, eta=0.05, zeta=0.05, incompressible=3.0,
        muscles=((np.arange(0, n, 2), np.diag(np.eye(dim)[0])),), activation=np.array([[0.3]]),
    )  # fmt: skip


@DIM
def test_free_fall_is_the_symplectic_sequence(dim, rng):
    """v_n = n g dt, x_n = x + g dt^2 n (n + 1) / 2, F = I, to round-off: gravity deforms nothing."""
    model, inputs = jelly(dim, rng)
    inputs.activation[:] = 0.0
    g, n = np.array([0.5, -3.0, 2.0])[:dim], 50
    inputs.fields.force[:] = inputs.fields.mass[:, None] * g
    last = final(model, inputs)
    np.testing.assert_allclose(last.v, np.tile(n * DT * g, (len(last.v), 1)), rtol=0, atol=ROUND_OFF)
    np.testing.assert_allclose(last.x, inputs.state.x + DT**2 * n * (n + 1) / 2 * g, rtol=0, atol=ROUND_OFF)
    np.testing.assert_allclose(last.F, inputs.state.F, rtol=0, atol=ROUND_OFF)


@DIM
def test_damping_alone_is_a_geometric_sequence(dim, rng):
    """v_n = v exp(-damping n dt) for a body that moves as one."""
    model, inputs = jelly(dim, rng)
    inputs.activation[:] = 0.0
    inputs.fields.damping[:] = 3.0
    inputs.state.v[:, 0] = 1.0
    last = final(model, inputs)
    np.testing.assert_allclose(last.v[:, 0], np.exp(-3.0 * 50 * DT), rtol=1e-12)


def linear_momentum(mass: np.ndarray, s: State) -> np.ndarray:
    """Return sum m v."""
    return mass @ s.v


def angular_momentum(mass: np.ndarray, s: State) -> np.ndarray:
    """Return sum m (x v^T - v x^T), with what APIC keeps in C: (dx^2 / 4) (C^T - C)."""
    moment = np.einsum("p,pi,pj->ij", mass, s.x, s.v) + DX**2 / 4 * np.einsum("p,pij->ji", mass, s.C)
    return moment - moment.T


@DIM
def test_a_strained_spinning_body_keeps_its_momenta(dim, rng):
    """Elastic, viscous and muscle stresses, all symmetric, change neither momentum; 50 substeps, to round-off."""
    model, inputs = jelly(dim, rng)
    s, mass = inputs.state, inputs.fields.mass
    s.v[:] = rng.normal(size=s.v.shape)
    s.C[:] = rng.normal(size=s.C.shape)
    s.F[:] += 0.05 * rng.normal(size=s.F.shape)
    last = final(model, inputs)
    assert np.abs(last.F - s.F).max() > 0.1
    for measure in (linear_momentum, angular_momentum):
        before = measure(mass, s)
        np.testing.assert_allclose(measure(mass, last), before, rtol=0, atol=ROUND_OFF * np.abs(before).max())


@DIM
def test_the_first_substep_keeps_the_motion_of_a_body_that_turns(dim, rng):
    """To round-off, wherever its particles lie: the start is one that a substep could have left."""
    material = {"density": 1.0, "elastic": {"fixed_corotated": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}
    spin = rng.normal(size=1 if dim == 2 else 3).tolist()
    body = {"shape": {"ball": {"center": [1.0] * dim, "radius": 0.2}}, "sampling": {"random": {"count": 40}}}
    body |= {"velocity": rng.normal(size=dim).tolist(), "spin": spin, "material": material}
    time = {"duration": 0.01, "control_step": 0.01}
    scene = load_scene(
        {"cqrun": 1, "world": {"size": [2.0] * dim, "dx": DX, "frame": "updated"}, "bodies": {"a": body}, "time": time}
    )
    start = Assembly(scene, sample(scene)).inputs({}).state
    model, inputs = world(start.x, size=[2.0] * dim, dx=DX, dt=1e-3, substeps=1, controls=1)
    after, _ = reference.substep(model, inputs, reference.Moving(start.x, start.v, start.C, start.F), 0)
    np.testing.assert_allclose(after.v, start.v, rtol=0, atol=ROUND_OFF)
    np.testing.assert_allclose(after.C, start.C, rtol=0, atol=ROUND_OFF / DX)


@needs_jit
@DIM
def test_a_spinning_block_turns_by_omega_t_and_keeps_its_shape(dim):
    """One revolution of a stiff block: 1e-3 in the angle (it widens by rho w^2 r^2 / E), 1e-4 m in shape."""
    omega, E = 2.0, 1e3
    x = lattice([0.8] * dim, [0.4] * dim, DX / 2)
    axis = np.array([0.6, 0.0, 0.8])
    K = np.array([[0.0, -1.0], [1.0, 0.0]]) if dim == 2 else np.cross(np.eye(3), -axis)
    volume, steps = (DX / 2) ** dim, 2888
    model, inputs = world(
        x, size=[2.0] * dim, dx=DX, dt=2 * np.pi / omega / steps, substeps=steps // 8, controls=8, mass=volume,
        volume=volume, E=E, nu=0.3,
    )  # fmt: skip
    arm = x - x.mean(0)
    inputs.state.v[:], inputs.state.C[:] = omega * arm @ K.T, omega * K
    time, positions = history(model, inputs, lambda s: s.x - s.x.mean(0))
    for t, at in zip(time, positions, strict=True):
        R = np.eye(dim) + np.sin(omega * t) * K + (1 - np.cos(omega * t)) * K @ K
        np.testing.assert_allclose(at, arm @ R.T, rtol=0, atol=1e-3 * np.abs(arm).max() + 1e-4)


@DIM
def test_the_sampling_of_the_mass_does_not_matter_to_a_falling_centre(dim, rng):
    """The centre of mass of bodies that collide moves on as if they did not."""
    model, inputs = jelly(dim, rng)
    halves = replace(model, layout=replace(model.layout, counts=(len(inputs.state.x) // 2,) * 2), body_names=("a", "b"))
    halves = replace(halves, groups=(replace(model.groups[0], bodies=(0, 1)),))
    inputs.state.v[: len(inputs.state.v) // 2, 0] = 1.0
    last, mass = final(halves, inputs), inputs.fields.mass
    moved = mass @ (last.x - inputs.state.x)
    np.testing.assert_allclose(moved, 50 * DT * linear_momentum(mass, inputs.state), rtol=0, atol=1e-14)

"""Bodies of the reference frame on floors: where they rest, how they bounce, slide and stick."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.model import Built, build
from cqrun.engine.frames import make_rollout
from cqrun.scene.load import load_scene
from cqrun.state import State

pytestmark = needs_jit

G, E, RHO, NU = 9.81, 1e5, 1000.0, 0.3
WAVE = np.sqrt(E * (1 - NU) / ((1 + NU) * (1 - 2 * NU)) / RHO)
"""Speed of pressure waves [m/s]."""

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])


def block(dim: int, height: float, *, dx: float = 0.01, side: float = 0.06, duration: float = 0.3, **changes: Any):
    """Return a block of neo-Hookean material above a floor without friction, built; `changes` are sections."""
    size, corner, gravity = [0.2] * dim, [0.07] * dim, [0.0] * dim
    corner[-1], gravity[-1] = 0.04 + height, -G
    law = {"neo_hookean": {"youngs_modulus": E, "poissons_ratio": NU}}
    body = {"shape": {"box": {"corner": corner, "size": [side] * dim}}, "particles_per_cell": 2**dim}
    body |= {"material": {"density": RHO, "elastic": law}}
    floor = {"face": f"{'xyz'[dim - 1]}_min", "thickness": 0.04, "dashpot": 0.0}
    scene = {
        "cqrun": 1, "world": {"size": size, "dx": dx, "gravity": gravity, "frame": "reference"},
        "bodies": {"block": body}, "boundaries": {"floor": {"separate": floor}},
        "time": {"duration": duration, "control_step": 1e-3},
    }  # fmt: skip
    return build(load_scene(scene | changes))


def heights(built: Built) -> np.ndarray:
    """Return the mean height of all particles above the start at every control step [m]."""
    found: list[float] = []
    make_rollout(built.model, built.assembly.inputs({})).run(observe=lambda _, s: found.append(s.x[:, -1].mean()))
    return np.array(found) - found[0]


def lowest(built: Built, q: np.ndarray) -> np.ndarray:
    """Return the heights of the surface's points above the floor, for a state of the nodes [m]."""
    rollout = make_rollout(built.model, built.assembly.inputs({}))
    points, dim = rollout.contacts.obstacles[0].surface.points, built.model.dim
    moved = np.einsum("sk,sk->s", points.weight, q[0][points.node, dim - 1])
    return built.model.surface.x[:, -1] + moved - 0.04


@DIM
def test_a_block_at_rest_stands_p_over_k_deep(dim):
    """The mean depth of its lower side is p dx / (5 E), a thousandth of a cell."""
    built = block(dim, 0.0, duration=1.0, loads={"air": {"damping": {"rate": 20.0}}})
    rollout = make_rollout(built.model, built.assembly.inputs({}))
    rollout.run()
    depth = -lowest(built, rollout.final)
    bottom = depth > -0.1 * built.model.dx
    surface = built.model.surface
    weight = built.assembly.inputs({}).fields.mass.sum() * G
    assert surface.stiffness[bottom] @ np.maximum(depth[bottom], 0) == pytest.approx(weight, rel=1e-3)
    pressed = RHO * G * 0.06 / (5 * E)  # of a cell
    assert depth.max() < 3 * pressed * built.model.dx
    assert pressed < 0.0013


@DIM
def test_a_dropped_block_bounces_and_keeps_its_energy(dim):
    """.6 to .7 of the height at 6 cells; energy within .7 % of m g H with a quarter of dx / c, without a dashpot."""
    substeps = int(np.ceil(1e-3 * WAVE / (0.25 * 0.01)))
    built = block(dim, 0.02, time={"duration": 0.3, "control_step": 1e-3, "substeps": substeps})
    assert built.model.dt <= 0.25 * built.model.dx / WAVE
    y = heights(built)
    hit = int(np.argmax(np.diff(y) > 0))
    assert 0.6 < 1 + y[hit:].max() / 0.02 < 0.7
    energy = energies(built)
    assert np.abs(energy - energy[0]).max() < 0.007 * (RHO * 0.06**dim * G * 0.02)


def energies(built: Built) -> np.ndarray:
    """Return the energy of motion, strain, height and contact at the end of every control step but one substep [J]."""
    model, inputs = built.model, built.assembly.inputs({})
    rollout = make_rollout(model, inputs)
    mass, n, found = rollout.bundle.nodes.mass, len(rollout.bundle.nodes.mass), []
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    states = rollout.start[None].copy()
    for control in range(1, model.n_controls + 1):
        rollout.advance((control - 1) * model.substeps, control * model.substeps - 1, states, keep=False)
        before, state = states[0, :, :n].copy(), rollout.unpack(states[0], 0)
        depth = np.maximum(-lowest_of(rollout, model, states[0]), 0)
        rollout.advance(control * model.substeps - 1, control * model.substeps, states, keep=False)
        v = 0.5 * (before[1] + states[0, 1, :n])  # at the time of u
        J = np.linalg.det(state.F)
        strain = mu / 2 * ((state.F**2).sum(axis=(1, 2)) - model.dim) - mu * np.log(J) + lam / 2 * np.log(J) ** 2
        found.append(
            0.5 * (mass[:, None] * v**2).sum() + inputs.fields.volume @ strain
            + G * inputs.fields.mass @ state.x[:, -1] + 0.5 * model.surface.stiffness @ depth**2
        )  # fmt: skip
    return np.array(found)


def lowest_of(rollout, model, q) -> np.ndarray:
    """Return the heights of the surface's points above the floor [m]."""
    points = rollout.contacts.obstacles[0].surface.points
    moved = np.einsum("sk,sk->s", points.weight, q[0][points.node, model.dim - 1])
    return model.surface.x[:, -1] + moved - 0.04


def test_the_dashpot_takes_energy_from_every_bounce():
    rebounds = []
    for dashpot in (0.0, 0.3, 1.0):
        floor = {"floor": {"separate": {"face": "y_min", "thickness": 0.04, "dashpot": dashpot}}}
        y = heights(block(2, 0.02, boundaries=floor))
        rebounds.append(1 + y[int(np.argmax(np.diff(y) > 0)) :].max() / 0.02)
    assert rebounds[0] > rebounds[1] + 0.05
    assert rebounds[1] > 0.4
    assert rebounds[0] > rebounds[2] + 0.05


# --- an incline ------------------------------------------------------------------------------------------------------


def slide(
    dim: int, tilted: bool, mu: float, angle: float, v0: float, duration: float, damping: float = 0.0, eta: float = 0.0
):
    """Return times, and the mean (velocity, displacement) along and across the incline at each.

    Either gravity is tilted, or the block and the floor, which is then a half-space.
    """
    turn = np.eye(dim)
    if tilted:
        turn[0, 0] = turn[-1, -1] = np.cos(angle)
        turn[0, -1], turn[-1, 0] = np.sin(angle), -np.sin(angle)
    along, up, down = turn @ np.eye(dim)[0], turn @ np.eye(dim)[-1], np.array([np.sin(angle), -np.cos(angle)])
    corner = np.full(dim, 0.3)
    corner[-1] = 1.2
    place = {"angle": -np.rad2deg(angle)} if dim == 2 else {"rotation": [0.0, np.rad2deg(angle), 0.0]}
    law = {"fixed_corotated": {"youngs_modulus": 2e6, "poissons_ratio": NU}}
    body: dict[str, Any] = {
        "shape": {"box": {"corner": [0.0] * dim, "size": [0.4] * dim}}, "particles_per_cell": 2**dim,
        "place": {"offset": corner.tolist()} | (place if tilted else {}), "velocity": (v0 * along).tolist(),
        "material": {"density": RHO, "elastic": law, "viscosity": {"shear": eta, "bulk": eta}},
    }  # fmt: skip
    gravity = -G * np.eye(dim)[-1] if tilted else G * (down[0] * along + down[1] * up)
    floor = {"region": {"half_space": {"point": corner.tolist(), "normal": up.tolist()}}, "coefficient": mu}
    scene = {
        "cqrun": 1, "bodies": {"block": body}, "boundaries": {"floor": {"friction": floor}},
        "world": {"size": [3.0] + [1.0] * (dim - 2) + [2.0], "dx": 0.1, "gravity": gravity.tolist(),
                  "frame": "reference"},
        "time": {"duration": duration, "control_step": duration / 100},
        "loads": {"air": {"damping": {"rate": damping}}},
    }  # fmt: skip
    built, axes, found = build(load_scene(scene)), np.stack([along, up], axis=1), []

    def see(_: int, state: State) -> None:
        found.append(np.append(state.v.mean(axis=0) @ axes, state.x.mean(axis=0) @ axes))

    make_rollout(built.model, built.assembly.inputs({})).run(observe=see)
    motion = np.array(found)
    return np.arange(len(motion)) * built.scene.time.control_step, motion - [0, 0, *motion[0, 2:]]


@DIM
@pytest.mark.parametrize("tilted", [False, True], ids=["gravity tilted", "floor tilted"])
@pytest.mark.parametrize(("mu", "angle"), [(0.0, 0.5), (0.3, 0.5), (0.2, 0.35)])
def test_a_block_slides(dim, tilted, mu, angle):
    """With g (sin t - mu cos t) to .3 %, and to 2e-4 with the momentum of its bouncing; it stays on the floor.

    In 3D a little is lost where friction turns with the wobble of a point.
    """
    time, found = slide(dim, tilted, mu, angle, v0=1.0, duration=0.5)
    expected = G * (np.sin(angle) - mu * np.cos(angle))
    assert np.polyfit(time, found[:, 0], 1)[0] == pytest.approx(expected, rel=3e-3)
    balance = (found[-1, 0] + mu * found[-1, 1] - 1.0) / time[-1]
    assert balance == pytest.approx(expected, rel=1e-12 if dim == 2 else 2e-4)
    assert np.abs(found[:, 3]).max() < 1e-3


@DIM
@pytest.mark.parametrize("tilted", [False, True], ids=["gravity tilted", "floor tilted"])
@pytest.mark.parametrize(("mu", "angle"), [(1.0, 0.2), (1.0, 0.5)])
def test_a_block_sticks(dim, tilted, mu, angle):
    """mu > tan t: it shears, and stays where a free one would have gone .6 to 1.4 m."""
    time, found = slide(dim, tilted, mu, angle, v0=0.0, duration=1.0, damping=3.0)
    later = time > 0.7
    assert np.abs(found[later, 2]).max() < 5e-3
    assert np.ptp(found[later, 2]) < 6e-4


def test_a_pushed_block_stops_where_its_energy_is_spent():
    """mu > tan t: after v^2 / 2 g (mu cos t - sin t), to .5 %.

    Viscosity ends the block's vibration: points that go to and fro on the floor rub in both directions, and a block
    without it slides 13 % too far.
    """
    mu, angle = 0.5, 0.3
    _, found = slide(2, True, mu, angle, v0=1.5, duration=1.1, eta=200.0)
    assert found[-1, 2] == pytest.approx(1.5**2 / (2 * G * (mu * np.cos(angle) - np.sin(angle))), rel=5e-3)
    assert abs(found[-1, 0]) < 0.01

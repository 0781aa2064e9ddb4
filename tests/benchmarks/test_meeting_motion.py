"""Bodies of the reference frame that meet each other: what they exchange and conserve, and how they slide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.model import Built, build
from cqrun.engine.frames import make_rollout
from cqrun.scene.load import load_scene

pytestmark = needs_jit

E, RHO, V = 1e6, 1000.0, 0.5
WAVE = np.sqrt(E / RHO)
"""Speed of waves along a bar [m/s]; its Poisson's ratio is 0."""

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
ROUND_OFF = 1e-13


def material(young: float = E, nu: float = 0.0, eta: float = 0.0) -> dict[str, Any]:
    """Return a neo-Hookean material."""
    law = {"neo_hookean": {"youngs_modulus": young, "poissons_ratio": nu}}
    return {"density": RHO, "elastic": law, "viscosity": {"shear": eta, "bulk": eta}}


def built_of(bodies: dict[str, Any], size: list[float], duration: float, dx: float = 0.01, **changes: Any) -> Built:
    """Return bodies in the reference frame, built; `changes` belong to `world`, or are sections."""
    world = {"size": size, "dx": dx, "frame": "reference"} | changes.pop("world", {})
    time = {"duration": duration, "control_step": duration / 60}
    for body in bodies.values():
        body.setdefault("particles_per_cell", 2 ** len(size))
    return build(load_scene({"cqrun": 1, "world": world, "bodies": bodies, "time": time, **changes}))


def bars(dim: int, *, shift: float = 0.0, ratio: float = 1.0, coefficient: float = 0.0, across: float = 0.0) -> Built:
    """Return a bar that meets another one at rest, end to end.

    Args:
        shift: of the second bar to the side [m].
        ratio: length of the second bar over that of the first.
        coefficient: of friction.
        across: velocity of the first bar to the side [m/s].
    """
    length, high, gap = 0.2, 0.04, 0.005
    side = [0.1] * (dim - 1)
    bodies = {
        "first": {"shape": {"box": {"corner": [0.1, *side], "size": [length] + [high] * (dim - 1)}},
                  "velocity": [V, across] + [0.0] * (dim - 2), "material": material()},
        "second": {"shape": {"box": {"corner": [0.1 + length + gap, *[s + shift for s in side]],
                                     "size": [ratio * length] + [high] * (dim - 1)}}, "material": material()},
    }  # fmt: skip
    contact = {"coefficient": coefficient, "dashpot": 0.0}
    duration = gap / V + 2 * length * max(1.0, ratio) / WAVE * 1.5
    return built_of(bodies, [0.8] + [0.3] * (dim - 1), duration, world={"contact": contact})


def momenta(built: Built) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean velocity of each body (T, B, D), the momentum (T, D) and the angular momentum (T, 3).

    They are sums over nodes, which carry the motion.
    """
    model, rollout = built.model, make_rollout(built.model, built.assembly.inputs({}))
    patches, mass, n = rollout.rest.patches, rollout.bundle.nodes.mass, len(rollout.bundle.nodes.mass)
    X = np.pad(patches.positions(model.dx), ((0, 0), (0, 3 - model.dim)))
    states, found = rollout.start[None].copy(), []
    for control in range(model.n_controls + 1):
        u, v = states[0, 0, :n, :3], states[0, 1, :n, :3]
        parts = [slice(a, b) for a, b in zip(patches.begin[:-1], patches.begin[1:], strict=True)]
        means = np.array([mass[part] @ v[part] / mass[part].sum() for part in parts])
        turning = np.cross(X + u, mass[:, None] * v).sum(axis=0)
        found.append((means[:, : model.dim], mass @ v[:, : model.dim], turning))
        if control < model.n_controls:
            rollout.advance(control * model.substeps, (control + 1) * model.substeps, states, keep=False)
    means, linear, angular = (np.array(each) for each in zip(*found, strict=True))
    return means, linear, angular


@DIM
@pytest.mark.parametrize("shift", [0.0, 0.003], ids=["point on point", "shifted"])
def test_two_equal_bars_exchange_their_velocities(dim, shift):
    """To .97 of theory; momentum to round-off, also the angular one, because a force and its opposite share a line."""
    means, linear, angular = momenta(bars(dim, shift=shift))
    assert means[-1, 1, 0] / V == pytest.approx(0.99, abs=0.02)
    assert abs(means[-1, 0, 0]) / V < 0.03
    np.testing.assert_allclose(linear, np.tile(linear[0], (len(linear), 1)), rtol=0, atol=ROUND_OFF * linear[0, 0])
    scale = np.abs(angular[0]).max()
    np.testing.assert_allclose(angular, np.tile(angular[0], (len(angular), 1)), rtol=0, atol=1e-11 * scale)


def test_a_longer_bar_takes_all_of_the_momentum():
    """A bar that hits one of twice its length comes to rest, and that goes on at half the speed."""
    means, linear, _ = momenta(bars(2, ratio=2.0))
    assert means[-1, 0, 0] / V == pytest.approx(0.0, abs=0.03)
    assert means[-1, 1, 0] / V == pytest.approx(0.5, abs=0.015)
    np.testing.assert_allclose(linear[-1], linear[0], rtol=0, atol=ROUND_OFF * linear[0, 0])


def test_friction_between_bodies_keeps_the_momentum():
    """It drags the other bar along to the side."""
    means, linear, _ = momenta(bars(2, coefficient=0.5, across=0.1))
    np.testing.assert_allclose(linear, np.tile(linear[0], (len(linear), 1)), rtol=0, atol=ROUND_OFF * linear[0, 0])
    free, _, _ = momenta(bars(2, across=0.1))
    assert means[-1, 1, 1] > 3 * abs(free[-1, 1, 1])


@DIM
def test_a_block_slides_over_a_plate(dim):
    """With -mu g, to 1 %, over eleven cells of a plate that is clamped; it stays on it."""
    g, mu, v0, duration = 9.81, 0.3, 1.0, 0.12
    side = [0.1] * (dim - 2)
    plate = {"shape": {"box": {"corner": [0.02, *side, 0.06], "size": [0.32, *[0.08] * (dim - 2), 0.04]}}}
    block = {"shape": {"box": {"corner": [0.05, *[0.12] * (dim - 2), 0.1], "size": [0.06, *[0.04] * (dim - 2), 0.04]}}}
    bodies = {
        "plate": plate | {"material": material(eta=20.0, nu=0.3)},
        "block": block | {"material": material(eta=20.0, nu=0.3), "velocity": [v0] + [0.0] * (dim - 1)},
    }  # fmt: skip
    clamp = {"sticky": {"region": {"box": {"corner": [0.0] * dim, "size": [0.4, *[0.3] * (dim - 2), 0.08]}}}}
    gravity = [0.0] * (dim - 1) + [-g]
    built = built_of(bodies, [0.4, *[0.3] * (dim - 2), 0.2], duration, boundaries={"clamp": clamp},
                     world={"gravity": gravity, "contact": {"coefficient": mu}})  # fmt: skip
    part, found = built.particles.of("block"), []
    make_rollout(built.model, built.assembly.inputs({})).run(
        observe=lambda _, s: found.append((*s.v[part].mean(axis=0), *s.x[part].mean(axis=0)))
    )
    motion, time = np.array(found), np.arange(61) * duration / 60
    later = time > 0.3 * duration
    assert np.polyfit(time[later], motion[later, 0], 1)[0] == pytest.approx(-mu * g, rel=0.01)
    assert motion[-1, dim] - motion[0, dim] > 0.09
    assert np.ptp(motion[:, 2 * dim - 1]) < 0.1 * built.model.dx


@DIM
@pytest.mark.parametrize("shift", [0.0, 0.0033], ids=["head-on", "beside"])
def test_two_balls_push_each_other_along_the_line_of_their_centres(dim, shift):
    """The impulse is within 2 % of it, with facets of a tenth of the radius; nearly all of the speed comes back."""
    radius, at = 0.05, [[0.1, *[0.15] * (dim - 1)], [0.207, *[0.15 + shift] * (dim - 1)]]
    bodies = {
        name: {"shape": {"ball": {"center": centre, "radius": radius}}, "velocity": [v] + [0.0] * (dim - 1),
               "material": material(1e5, 0.3)}
        for name, centre, v in (("left", at[0], 0.3), ("right", at[1], -0.3))
    }  # fmt: skip
    means, linear, _ = momenta(built_of(bodies, [0.3] * dim, 0.06))
    across = np.subtract(at[1], at[0])[1:]
    line = np.array([np.sqrt((2 * radius) ** 2 - across @ across), *across]) / (2 * radius)
    impulse = means[0, 0] - means[-1, 0]
    assert np.linalg.norm(impulse - line * (impulse @ line)) < 0.02 * np.linalg.norm(impulse)
    assert -means[-1, 0, 0] / 0.3 > 0.9
    np.testing.assert_allclose(linear, 0.0, atol=ROUND_OFF * RHO * radius**dim)

"""A soft block on an inclined plane that moves: friction pulls it towards the plane's speed, and holds it there."""

from __future__ import annotations

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.scene.load import load_scene
from cqrun.state import State

pytestmark = needs_jit

G = 10.0


def slide(
    dim: int, mu: float, angle: float, speed: float, duration: float = 0.4, eta: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return times, and the mean velocity of the block along and across the incline at each.

    The plane is a rigid box on a path along the incline, and gravity is tilted. The block starts at 1 m/s.
    """
    end, low, wide = duration * speed, [0.3] * dim, [0.4] * dim
    corner, size = [-3.0] + [0.05] * (dim - 1), [9.0] + [0.9] * (dim - 1)
    low[-1], size[-1] = 1.0, 0.95
    law = {"fixed_corotated": {"youngs_modulus": 2e6, "poissons_ratio": 0.3}}
    scene = {
        "cqrun": 1,
        "world": {"size": [3.0] + [1.0] * (dim - 2) + [2.0], "dx": 0.1, "frame": "reference",
                  "gravity": [G * np.sin(angle)] + [0.0] * (dim - 2) + [-G * np.cos(angle)]},
        "bodies": {"block": {
            "shape": {"box": {"corner": low, "size": wide}}, "particles_per_cell": 2**dim,
            "velocity": [1.0] + [0.0] * (dim - 1),
            "material": {"density": 1000.0, "elastic": law, "viscosity": {"shear": eta, "bulk": eta}},
        }},
        "rigid": {"plane": {
            "shape": {"box": {"corner": corner, "size": size}}, "friction": mu,
            "path": [{"time": 0}, {"time": duration, "displacement": [end] + [0.0] * (dim - 1)}],
        }},
        "time": {"duration": duration, "control_step": duration / 80},
    }  # fmt: skip
    built, found = build(load_scene(scene)), []

    def see(_: int, state: State) -> None:
        found.append(state.v[: len(built.particles.x)].mean(axis=0)[[0, -1]])

    make_rollout(built.model, built.assembly.inputs({})).run(observe=see)
    return np.linspace(0.0, duration, len(found)), np.array(found)


@pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
@pytest.mark.parametrize("speed", [-2.0, 0.5, 6.0], ids=["against it", "slower", "faster"])
@pytest.mark.parametrize(("mu", "angle"), [(0.3, 0.5), (0.2, 0.35)])
def test_friction_pulls_a_block_towards_the_speed_of_the_plane(dim, speed, mu, angle):
    """a = g (sin t - mu cos t) on a slower plane, g (sin t + mu cos t) on a faster one, to 0.5 %, with its bounces."""
    time, found = slide(dim, mu, angle, speed)
    pull = np.sign(speed - 1.0) * mu
    assert np.polyfit(time, found[:, 0], 1)[0] == pytest.approx(G * (np.sin(angle) + pull * np.cos(angle)), rel=5e-3)


def test_a_plane_takes_a_block_with_it():
    """mu > tan t: with g (mu cos t + sin t) friction brings it to the speed of the plane, 2 m/s, and holds it there."""
    mu, angle = 0.3, 0.1
    time, found = slide(2, mu, angle, 2.0, duration=0.8, eta=200.0)
    expected = G * (mu * np.cos(angle) + np.sin(angle))
    early = time < 0.8 / expected
    assert np.polyfit(time[early], found[early, 0], 1)[0] == pytest.approx(expected, rel=1e-2)
    later = found[time > 2.0 / expected, 0]
    assert later.mean() == pytest.approx(2.0, rel=5e-3)
    assert np.ptp(later) < 0.04  # it shears to and fro on the points that stick

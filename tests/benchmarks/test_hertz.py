"""A rigid ball pressed into an elastic layer: the force of Hertz's law, corrected for a layer that is glued below.

H. Hertz (1882): a half-space feels F = 4/3 E / (1 - nu^2) sqrt(R d^3) at the depth d. E. K. Dimitriadis et al.
(Biophysical Journal 82, 2002) multiply it by a series in chi = sqrt(R d) / thickness. The law is for small strains, so
the ball is large: R is 20 contact radii.
"""

from __future__ import annotations

import csv
from math import pi, sqrt
from typing import Any

import pytest
from little_worlds import needs_jit

from cqrun.jobs.rest import REST
from cqrun.scene.load import load_scene

pytestmark = [needs_jit, pytest.mark.slow]

E, NU, RADIUS, BALL = 1e5, 0.3, 0.005, 0.1
"""Pa; of the contact, and of the ball [m]."""

DEPTH = RADIUS**2 / BALL
THICK, WIDE, MARGIN = 2.0, 3.5, 4
"""Thickness and half the width of the layer in contact radii; cells around it."""


def scene(cells: int) -> dict[str, Any]:
    """Return a layer and a ball, with so many cells in the contact's radius."""
    dx = RADIUS / cells
    low, width, thick = MARGIN * dx, 2 * WIDE * RADIUS, THICK * RADIUS
    x, top = low + 0.5 * width, low + thick
    size = [width + 2 * low, width + 2 * low, thick + 3 * low]
    material = {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": E, "poissons_ratio": NU}}}
    layer = {"shape": {"box": {"corner": [low] * 3, "size": [width, width, thick]}}, "particles_per_cell": 8}
    below = {"box": {"corner": [0, 0, 0], "size": [*size[:2], low]}}
    return {
        "cqrun": 1,
        "job": "rest",
        "world": {"size": size, "dx": dx},
        "bodies": {"layer": {**layer, "material": material}},
        "boundaries": {"table": {"sticky": {"region": below}}},
        "rigid": {"ball": {"shape": {"ball": {"center": [x, x, top + BALL], "radius": BALL}}}},
        "measure": {"force": {"reaction": {"boundary": "ball"}}},
        "path": {"rigid.ball.offset.2": [-DEPTH]},
    }


def expected() -> float:
    """Return the force on the layer [N]."""
    a = -(1.2876 - 1.4678 * NU + 1.3442 * NU**2) / (1 - NU)
    b = (0.6387 - 1.0277 * NU + 1.5164 * NU**2) / (1 - NU)
    chi = 1 / THICK
    series = 1 - 2 * a / pi * chi + 4 * a**2 / pi**2 * chi**2
    series -= 8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b) * chi**3
    series += 16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b) * chi**4
    return 4 / 3 * E / (1 - NU**2) * sqrt(BALL * DEPTH**3) * series


@pytest.mark.parametrize("cells", [5, 10])
def test_the_force_on_a_ball_is_that_of_hertz(cells, tmp_path):
    run = REST.start("hertz", load_scene(scene(cells)), tmp_path)
    with (run / "measurements.csv").open() as file:
        force = -float(list(csv.DictReader(file))[-1]["force.z"])
    assert force == pytest.approx(expected(), rel=0.03), force / expected()

"""What a law answers in the three tests of a laboratory, for a body that keeps its volume, and where it is stable.

A stretch l along the first axis comes with a second one of

    uniaxial: l^(-1/2),   planar (pure shear): 1,   equibiaxial: l,

and the third keeps the volume. The pressure is free, and the third face has no force: the nominal stress is

    P = (tau_1 - tau_3) / l

with the Kirchhoff stress of the law (Ogden, Non-linear Elastic Deformations, 1984, section 7.1). So a law's file says
once what it is. A law is stable in a test while P grows with l (Drucker).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from cqrun.materials.term import kirchhoff
from cqrun.plugin.contract import Array

Mode = Literal["uniaxial", "planar", "equibiaxial"]
MODES: Mapping[Mode, float] = {"uniaxial": -0.5, "planar": 0.0, "equibiaxial": 1.0}
"""The power of the stretch that is the second stretch."""

STEP = 1e-4
"""Relative step of the differences by which slopes are found."""

FARTHEST, FINE = 10.0, 400
"""Stability is looked for up to this stretch if no other is given, at so many stretches on each side of 1."""


def nominal_stress(spec: Any, theta: Array, mode: Mode, stretch: Array) -> Array:
    """Return the nominal stress (n,) [Pa] of an elastic law.

    Args:
        spec: the law.
        theta: rows of its parameters (rows,) or (rows, n).
        mode: the test.
        stretch: (n,) along the first axis; below 1 in compression.
    """
    first = np.asarray(stretch, float)
    second = first ** MODES[mode]
    third, zero = 1.0 / (first * second), 0.0 * first
    F = (first, zero, zero, zero, second, zero, zero, zero, third)
    rows = tuple(np.broadcast_to(row, first.shape) for row in theta)
    tau = kirchhoff(spec.kernel_term(np.asarray(theta)), rows, F, (zero,) * 9)
    return np.asarray((tau[0] - tau[8]) / first)


def nominal_slope(spec: Any, theta: Array, mode: Mode, stretch: Array) -> Array:
    """Return the slope of the nominal stress by the stretch (n,) [Pa], by differences of the fourth order."""
    stretch = np.asarray(stretch, float)
    h = STEP * stretch
    near, far = (
        nominal_stress(spec, theta, mode, stretch + k * h) - nominal_stress(spec, theta, mode, stretch - k * h)
        for k in (1, 2)
    )
    return np.asarray((8.0 * near - far) / (12.0 * h))


def stable_range(spec: Any, theta: Array, mode: Mode, farthest: float = FARTHEST) -> tuple[float, float]:
    """Return the stretches around 1 between which the nominal stress grows: 0.1 and 10 if it does everywhere.

    Args:
        spec, theta, mode: as for `nominal_stress`, with theta (rows,).
        farthest: the largest stretch that is looked at; 1 / farthest is the smallest.
    """
    ends = []
    for end in (1.0 / farthest, farthest):
        stretch = np.geomspace(1.0, end, FINE)
        with np.errstate(all="ignore"):
            falls = ~(nominal_slope(spec, theta, mode, stretch) > 0.0)
        ends.append(float(stretch[np.argmax(falls)]) if falls.any() else end)
    return ends[0], ends[1]


def stable_to(spec: Any, theta: Array, modes: Sequence[Mode] = tuple(MODES)) -> dict[Mode, float]:
    """Return, by test, the largest stretch up to which a law is stable."""
    return {mode: stable_range(spec, theta, mode)[1] for mode in modes}

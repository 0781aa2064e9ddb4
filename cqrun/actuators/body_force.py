"""Body force: an acceleration of a part of a body in a fixed direction, like a magnet's pull (CQ1's `F_controller`).

f_p = activation acceleration m_p n, with the unit vector n. It is the only actuator that adds momentum.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.actuators.actuator import RegionActuator
from cqrun.explain import Loc
from cqrun.forces.force import Levels
from cqrun.forces.steady import register_steady, starts_of
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array, quantity, vector
from cqrun.plugin.registry import plugin
from cqrun.state import MASS


class BodyForceKernel(NamedTuple):
    """All body forces of a scene."""

    start: Array  # (A_k + 1,) where an actuator's particles begin
    columns: Array
    actuators: Array  # (A_k,)
    direction: Array  # (A_k, D)


@plugin("actuator", "body_force")
class BodyForce(RegionActuator):
    """An acceleration along a direction of the world: the activation times `acceleration`."""

    direction: list[float] = vector("1", "Direction in the world, of any length")
    acceleration: float = quantity("m/s^2", "Acceleration at activation 1", differentiable=True, ge=0)

    scale = "acceleration"
    kernel = BodyForceKernel
    per = "mass"

    def potential(self, constants: Array, x: Array, F: Array) -> Array:
        """Return the energy per mass (T, n) whose negative derivative by x is the acceleration, for a level of 1."""
        return -(x @ constants)

    def potential_vjp(self, constants: Array, x: Array, F: Array, bar: Array) -> tuple[Array | None, Array | None]:
        """Return the cotangents of x and F; None for zero."""
        return -bar[..., None] * constants, None

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems = super().dim_problems(dim)
        return problems if np.any(self.direction) else [*problems, (("direction",), "must not be zero")]

    def greatest_acceleration(self, strength: float) -> float:
        """Return the acceleration of its particles [m/s^2]."""
        return abs(strength)

    def constants(self, x: Array) -> Array:
        """Return the unit direction (D,)."""
        return np.array(self.direction) / np.linalg.norm(self.direction)


def make_kernel(actuators: Array, columns: list[Array], constants: list[Array]) -> BodyForceKernel:
    """Return the kernels' view of all body forces."""
    return BodyForceKernel(*starts_of(columns), actuators, np.array(constants))


@kernel
def accelerate(bodies: BodyForceKernel, levels: Levels, control: int, fields: Array, force: Array) -> None:
    """Add the forces."""
    w = force.shape[2]
    for k in range(len(bodies.actuators)):
        a = bodies.actuators[k]
        pull = levels.activation[control, a] * levels.strength[a]
        for index in range(bodies.start[k], bodies.start[k + 1]):
            p = bodies.columns[index]
            for d in range(force.shape[1]):
                force[p // w, d, p % w] += pull * fields[p // w, MASS, p % w] * bodies.direction[k, d]


@kernel
def accelerate_vjp(
    bodies: BodyForceKernel, levels: Levels, levels_bar: Levels, control: int, fields: Array, fields_bar: Array,
    force_bar: Array,
) -> None:  # fmt: skip
    """Carry the cotangent of the forces back to activation, strength and mass."""
    w = force_bar.shape[2]
    for k in range(len(bodies.actuators)):
        a, total = bodies.actuators[k], 0.0
        pull = levels.activation[control, a] * levels.strength[a]
        for index in range(bodies.start[k], bodies.start[k + 1]):
            p = bodies.columns[index]
            along = 0.0
            for d in range(force_bar.shape[1]):
                along += force_bar[p // w, d, p % w] * bodies.direction[k, d]
            total += along * fields[p // w, MASS, p % w]
            fields_bar[p // w, MASS, p % w] += pull * along
        levels_bar.activation[control, a] += total * levels.strength[a]
        levels_bar.strength[a] += total * levels.activation[control, a]


register_steady(BodyForceKernel, make_kernel, accelerate, accelerate_vjp)

"""Turn activations into active stresses and steady forces, once per control step, and the adjoint; on one thread.

theta_p = sum_a activation_a strength_a weight_ap direction_a over the stress actuators a of particle p. Steady forces
have their own functions (`forces/steady.py`).
"""

from __future__ import annotations

from typing import Any

from cqrun.engine.setting import Drive, Stresses
from cqrun.forces.force import Levels
from cqrun.forces.pulled import Pulled
from cqrun.forces.steady import hold, hold_vjp
from cqrun.numerics.compile import for_each, kernel
from cqrun.plugin.contract import Array


@kernel
def stress(stresses: Stresses, activation: Array, strength: Array, control: int) -> None:
    """Fill the parameters of one kind of active stress."""
    width = stresses.theta.shape[2]
    stresses.theta[:] = 0.0
    for k in range(len(stresses.actuators)):
        a = stresses.actuators[k]
        for row in range(stresses.direction.shape[1]):
            tension = activation[control, a] * strength[a] * stresses.direction[k, row]
            if tension == 0.0:  # a muscle along an axis has one row that is not zero
                continue
            for index in range(stresses.start[k], stresses.start[k + 1]):
                p = stresses.columns[index]
                stresses.theta[p // width, row, p % width] += tension * stresses.weight[index]


@kernel
def stress_vjp(pair: tuple[Stresses, Stresses], activation: Array, strength: Array, control: int, bar: Levels) -> None:
    """Add the cotangent of theta, summed over a control step, to those of activation, strength, weight; clear it."""
    stresses, theta_bar = pair[0], pair[1].theta
    width = theta_bar.shape[2]
    for k in range(len(stresses.actuators)):
        a, total = stresses.actuators[k], 0.0
        for row in range(stresses.direction.shape[1]):
            along = stresses.direction[k, row]
            if along == 0.0:
                continue
            for index in range(stresses.start[k], stresses.start[k + 1]):
                p = stresses.columns[index]
                pull = theta_bar[p // width, row, p % width] * along
                total += pull * stresses.weight[index]
                pair[1].weight[index] += pull * activation[control, a] * strength[a]
        bar.activation[control, a] += total * strength[a]
        bar.strength[a] += total * activation[control, a]
    theta_bar[:] = 0.0


@kernel
def clear(kind: Any, force: Array) -> None:
    """Set the force on the particles in `kind.columns` to zero."""
    width = force.shape[2]
    for p in kind.columns:
        force[p // width, :, p % width] = 0.0


@kernel
def clear_all(kind: Any, force: Array) -> None:
    """Set the force on all particles to zero."""
    force[:] = 0.0


@kernel
def keep_base(pulled: Pulled, push: Array) -> None:
    """Keep the steady forces on the particles that other forces pull, too."""
    width = push.shape[2]
    for j in range(len(pulled.columns)):
        p = pulled.columns[j]
        for d in range(push.shape[1]):
            pulled.base[j, d] = push[p // width, d, p % width]


stress_of_each = for_each(stress)
stress_vjp_of_each = for_each(stress_vjp)
clear_each = for_each(clear)
clear_all_for_each = for_each(clear_all)
keep_base_of_each = for_each(keep_base)
hold_of_each = for_each(hold)
hold_vjp_of_each = for_each(hold_vjp)


@kernel
def activate(drive: Drive, fields: Array, push: Array, control: int) -> None:
    """Set the active stresses and the steady forces of a control step."""
    levels = drive.levels
    stress_of_each(drive.stresses, levels.activation, levels.strength, control)
    clear_each(drive.pulled, push)
    clear_each(drive.steady, push)
    hold_of_each(drive.steady, levels, control, fields, push)
    keep_base_of_each(drive.pulled, push)


@kernel
def activate_vjp(
    stresses: Any, drive: Drive, levels_bar: Levels, fields: Array, fields_bar: Array, steady_bar: Array, control: int
) -> None:
    """Run the adjoint of `activate` for pairs of active stresses and their cotangents; clear the cotangents."""
    levels = drive.levels
    stress_vjp_of_each(stresses, levels.activation, levels.strength, control, levels_bar)
    hold_vjp_of_each(drive.steady, levels, levels_bar, control, fields, fields_bar, steady_bar)
    clear_all_for_each(drive.steady, steady_bar)

"""Activations to active stresses, once a control step, and to forces, every substep; and back. One thread runs these.

theta_p = sum_a activation_a strength_a weight_ap direction_a over the stress actuators a that hold particle p; what
forces do is their own (`actuators/push.py`).
"""

from __future__ import annotations

from typing import Any

from cqrun.actuators.push import push, push_vjp
from cqrun.engine.setting import Drive, Stresses
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
            if tension == 0.0:  # as in all rows but one of a muscle along an axis
                continue
            for index in range(stresses.start[k], stresses.start[k + 1]):
                p = stresses.columns[index]
                stresses.theta[p // width, row, p % width] += tension * stresses.weight[index]


@kernel
def stress_vjp(pair: tuple[Stresses, Stresses], activation: Array, strength: Array, control: int, bar: Drive) -> None:
    """Turn the cotangent of theta, summed over a control step, into those of activation, strength, weight; clear it."""
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
def clear_push(force_kernel: Any, force: Array) -> None:
    """Forget what the actuators of one kind pushed."""
    width = force.shape[2]
    for p in force_kernel.columns:
        force[p // width, :, p % width] = 0.0


stress_of_each = for_each(stress)
stress_vjp_of_each = for_each(stress_vjp)
clear_each_push = for_each(clear_push)
push_of_each = for_each(push)
push_vjp_of_each = for_each(push_vjp)


@kernel
def activate(drive: Drive, control: int) -> None:
    """Set the active stresses of a control step."""
    stress_of_each(drive.stresses, drive.activation, drive.strength, control)


@kernel
def activate_vjp(drive: Drive, drive_bar: Drive, pairs: Any, control: int) -> None:
    """Carry the cotangents of a control step's active stresses back; `pairs` are the stresses with theirs."""
    stress_vjp_of_each(pairs, drive.activation, drive.strength, control, drive_bar)


@kernel
def push_particles(drive: Drive, control: int, q: Array, fields: Array) -> None:
    """Set the actuators' forces at the state q."""
    clear_each_push(drive.forces, drive.push)
    push_of_each(drive.forces, drive, control, q, fields, drive.push)


@kernel
def push_particles_vjp(
    drive: Drive, drive_bar: Drive, control: int, q: Array, q_bar: Array, fields: Array, fields_bar: Array
) -> None:
    """Add what the forces' cotangent (`drive_bar.push`) gives to those of state, fields and activations."""
    push_vjp_of_each(drive.forces, drive, drive_bar, control, q, q_bar, fields, fields_bar)

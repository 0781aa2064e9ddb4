"""Activations to active stresses, once a control step, and back.

S_p = sum_a tension_a direction_a over the actuators a that hold particle p. One thread runs these.
"""

from __future__ import annotations

from cqrun.compile import kernel
from cqrun.engine.setting import Muscles


@kernel
def activate(muscles: Muscles, control: int) -> None:
    """Fill S from the tensions of a control step."""
    if muscles.tension.shape[1] == 0:
        return
    width = muscles.S.shape[2]
    muscles.S[:] = 0.0
    for a in range(muscles.tension.shape[1]):
        for row in range(muscles.direction.shape[1]):
            stress = muscles.tension[control, a] * muscles.direction[a, row]
            for index in range(muscles.start[a], muscles.start[a + 1]):
                p = muscles.columns[index]
                muscles.S[p // width, row, p % width] += stress


@kernel
def activate_vjp(muscles: Muscles, muscles_bar: Muscles, control: int) -> None:
    """Turn the cotangent of S, summed over a control step, into that of its tensions; clear it."""
    if muscles.tension.shape[1] == 0:
        return
    width = muscles.S.shape[2]
    for a in range(muscles.tension.shape[1]):
        total = 0.0
        for row in range(muscles.direction.shape[1]):
            for index in range(muscles.start[a], muscles.start[a + 1]):
                p = muscles.columns[index]
                total += muscles_bar.S[p // width, row, p % width] * muscles.direction[a, row]
        muscles_bar.tension[control, a] += total
    muscles_bar.S[:] = 0.0

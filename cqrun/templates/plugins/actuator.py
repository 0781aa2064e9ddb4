"""An actuator of your own: a stress that an activation drives. Here it is tau = a s F F^T, which contracts a body.

a is the activation and s the strength. Change `stress` to your actuator, and `stress_vjp` to its adjoint: for gradients
the two must agree, which `cqrun gradcheck my_actuator.yaml --allow-plugins` checks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.actuators.actuator import RegionActuator
from cqrun.materials.term import register, zeros_like_rows
from cqrun.numerics.tensor import inner, mul, mul_bt, scale, symmetric
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class MyActuatorKernel(NamedTuple):
    """What kernels see: one row, the activation times the strength [Pa], filled in every control step."""

    theta: Array
    rows: tuple[int, ...]


@plugin("actuator", "my_actuator")
class MyActuator(RegionActuator):
    """An active stress a s F F^T in the particles of a region: at an activation a > 0 the region contracts.

    This text is the page of the actuator: `cqrun describe actuator my_actuator --plugin my_actuator.py`.
    """

    strength: float = quantity("Pa", "Stress at activation 1", differentiable=True, ge=0)

    scale = "strength"  # the field that an activation is multiplied by
    kernel = MyActuatorKernel

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and largest activation."""
        return 0.0, 1.0

    def constants(self, x: Array) -> Array:
        """Return the row at an activation and a strength of 1, for particles at rest at x (n, D) [m]."""
        return np.ones(1)

    def wave_modulus(self) -> float:
        """Return the stiffness of a pressure wave that one unit of activation and strength adds."""
        return 1.0


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    return scale(mul_bt(F, F), theta[0])


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    pull = symmetric(tau_bar)
    return (inner(pull, mul_bt(F, F)),), scale(mul(pull, F), 2.0 * theta[0]), zeros_like_rows(F)


register(MyActuatorKernel, stress, stress_vjp, rate=False)

"""A further stress of a material, beside its elastic law. Here it is a simple viscosity: tau = 2 eta d.

d = sym(C) is the symmetric velocity gradient. Change `stress` to your law, and `stress_vjp` to its adjoint: for
gradients the two must agree, which `cqrun gradcheck my_material_term.yaml --allow-plugins` checks.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from cqrun.materials.term import MaterialTerm, register, zeros_like_rows
from cqrun.numerics.tensor import inner, scale, symmetric
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class MyMaterialTermKernel(NamedTuple):
    """What kernels see: one row, eta [Pa s]. This class selects the functions that kernels call."""

    theta: Array
    rows: tuple[int]


@plugin("material_term", "my_material_term")
class MyMaterialTerm(MaterialTerm):
    """A viscous stress, tau = 2 eta sym(C), with the velocity gradient C.

    This text is the page of the term: `cqrun describe material_term my_material_term --plugin my_material_term.py`.
    """

    parameters: ClassVar[tuple[str, ...]] = ("eta",)
    eta: float = quantity("Pa s", "Viscosity", differentiable=True, ge=0)

    def kernel_term(self, theta: Array) -> MyMaterialTermKernel:
        return MyMaterialTermKernel(theta, (0,))

    @staticmethod
    def wave_viscosity(theta: Array) -> Array:
        return np.asarray(2.0 * theta[0])  # the time step's bound


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    return scale(symmetric(C), 2.0 * theta[0])


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    pull = symmetric(tau_bar)
    return (2.0 * inner(pull, symmetric(C)),), zeros_like_rows(F), scale(pull, 2.0 * theta[0])


register(MyMaterialTermKernel, stress, stress_vjp)

"""Fibres in a material: psi = sum over directions of k/8 <a0 . C a0 - 1>^2, C = F^T F.

So tau = k/2 <|f|^2 - 1> f f^T with f = F a0, and fibres add k to Young's modulus along them. <x> is x, or 0 for x < 0
if fibres only pull. (The quadratic form of Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.8.)
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numba.extending import register_jitable
from pydantic import Field, field_validator

from cqrun.explain import Loc
from cqrun.materials.term import MaterialTerm, register, register_energy, zeros_like_rows
from cqrun.numerics.lanes import below, select
from cqrun.numerics.tensor import add, dot, matvec, matvec_t, outer, scale
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class FibreKernel(NamedTuple):
    """Kernels' view: row k [Pa], the unit vectors of all directions, and whether fibres only pull."""

    theta: Array
    rows: tuple[int]
    axes: tuple[tuple[float, ...], ...]
    tension_only: int


@plugin("material_term", "fibre")
class Fibre(MaterialTerm):
    """Fibres along one or more directions of the body at rest, which pull back when they are stretched.

    Young's modulus along a direction grows by the stiffness. A layer that bends but does not stretch is a region with
    stiff fibres in the two directions of its plane: give the body a `stiffness` of 0, and `material_of` the layer
    another one. A stiff isotropic skin would bend less, and need shorter substeps for its volume.
    """

    parameters: ClassVar[tuple[str, ...]] = ("stiffness",)
    stiffness: float = quantity("Pa", "Stiffness k of the fibres of each direction", differentiable=True, ge=0)
    directions: list[Annotated[list[float], Field(min_length=2, max_length=3)]] = Field(
        description="Directions of the fibres at rest, such as [[1, 0, 0]]; their lengths do not matter", min_length=1,
        max_length=3,
    )  # fmt: skip
    tension_only: bool = Field(
        description="Whether fibres have no stress while they are shorter than at rest", default=True
    )

    @field_validator("directions")
    @classmethod
    def _not_zero(cls, directions: list[list[float]]) -> list[list[float]]:
        for direction in directions:
            if not np.linalg.norm(direction) > 0:
                raise ValueError(f"{direction} has no length")
        return directions

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        return [
            *super().dim_problems(dim),
            *(
                (("directions", k), f"must have {dim} entries in this {dim}D world, has {len(direction)}")
                for k, direction in enumerate(self.directions)
                if len(direction) != dim
            ),
        ]

    def kernel_term(self, theta: Array) -> FibreKernel:
        units = [np.array(direction) / np.linalg.norm(direction) for direction in self.directions]
        axes = tuple(tuple(float(entry) for entry in unit) for unit in units)
        return FibreKernel(theta, (0,), axes, int(self.tension_only))

    def wave_modulus(self, theta: Array) -> Array:  # type: ignore[override]
        """Return k, or more where directions are not at right angles [Pa], shape (n,)."""
        axes = np.array(self.kernel_term(theta).axes)
        return np.asarray(theta[0] * np.linalg.eigvalsh(axes @ axes.T)[-1] ** 2)


@register_jitable
def strain(term: Any, f: Any) -> Any:
    """Return <|f|^2 - 1>, and its slope: 0 where a fibre is slack, 1 elsewhere."""
    e = dot(f, f) - 1.0
    taut = select(below(e * 0.0, e), e * 0.0 + 1.0, e * 0.0) if term.tension_only else e * 0.0 + 1.0
    return e * taut, taut


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    tau = zeros_like_rows(F)
    for axis in term.axes:
        f = matvec(F, axis)
        tau = add(tau, scale(outer(f, f), 0.5 * theta[0] * strain(term, f)[0]))
    return tau


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    F_bar = zeros_like_rows(F)
    k_bar = F[0] * 0.0
    for axis in term.axes:
        f = matvec(F, axis)
        e, taut = strain(term, f)
        along = add(matvec(tau_bar, f), matvec_t(tau_bar, f))
        pull = 0.5 * dot(f, along)
        k_bar = k_bar + 0.5 * e * pull
        f_bar = add(scale(along, 0.5 * theta[0] * e), scale(f, theta[0] * taut * pull))
        F_bar = add(F_bar, outer(f_bar, axis))
    return (k_bar,), F_bar, zeros_like_rows(F)


register(FibreKernel, stress, stress_vjp, rate=False)


def energy(term: Any, theta: Any, F: Any) -> Any:
    """Return psi."""
    psi = F[0] * 0.0
    for axis in term.axes:
        e = strain(term, matvec(F, axis))[0]
        psi = psi + 0.125 * theta[0] * e * e
    return psi


def energy_vjp(term: Any, theta: Any, F: Any, psi_bar: Any) -> Any:
    """Return (theta_bar, F_bar)."""
    F_bar, k_bar = zeros_like_rows(F), F[0] * 0.0
    for axis in term.axes:
        f = matvec(F, axis)
        e = strain(term, f)[0]
        k_bar = k_bar + 0.125 * e * e * psi_bar
        F_bar = add(F_bar, outer(scale(f, 0.5 * theta[0] * e * psi_bar), axis))
    return (k_bar,), F_bar


register_energy(FibreKernel, energy, energy_vjp)

"""Write the affine fields that particles scatter as entries of a tile."""

from __future__ import annotations

from typing import Any

from cqrun.engine.arrays import get_place, put_columns, put_vector
from cqrun.engine.reference.setting import TILE
from cqrun.engine.stencils import Stencils
from cqrun.numerics.compile import kernel
from cqrun.numerics.tensor import matvec, scale, sub
from cqrun.plugin.contract import Array


@kernel
def put_linear(value: Array, affine: Array, stencils: Stencils, i: int, at: int, A: Any, dims: Any) -> None:
    """Write the field A (o - f) of the lane of particles at i as entries `at` of a tile."""
    put_vector(value, at, scale(matvec(A, get_place(stencils.f, i, dims)), -1.0), 0.0, dims)
    put_columns(affine, TILE, at, A, dims)


@kernel
def put_affine(value: Array, affine: Array, stencils: Stencils, i: int, at: int, A: Any, a: Any, dims: Any) -> None:
    """Write the field a + A (o - f)."""
    put_vector(value, at, sub(a, matvec(A, get_place(stencils.f, i, dims))), 0.0, dims)
    put_columns(affine, TILE, at, A, dims)

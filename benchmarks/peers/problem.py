"""What is computed: a block of fixed-corotated material falls for a few substeps; each particle has its own modulus.

    momentum   (m v)_i = sum_p w_ip (m_p v_p + dt m_p g + (m_p C_p - dt 4 / dx^2 V_p tau_p) (x_i - x_p))
    stress     tau = 2 mu (F - R) F^T + lambda (J - 1) J I, F = R S
    motion     v_p = sum_i w_ip v_i, C_p = 4 / dx^2 sum_i w_ip v_i (x_i - x_p)^T, x_p += dt v_p, F_p = (I + dt C_p) F_p

with quadratic B-splines (MLS-MPM; CQ1 eqs 1 to 12). The loss is the mean of |x|^2 / 2 at the end. Its gradients
are by every particle's initial velocity and by its modulus.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from cqrun.engine.model import Inputs, Model
from cqrun.jobs.bench import falling_block
from cqrun.plugin.contract import Array

SIZES = {"2d_6400": (2, 80), "2d_102400": (2, 320), "3d_8000": (3, 20), "3d_64000": (3, 40)}
"""Name -> (dimension, particles along an edge)."""

SUBSTEPS = 40
"""In one call. The fixed cost of a call is spread over them, as over the hundreds of substeps of a rollout."""


@dataclass(frozen=True)
class Block:
    """Arrays of N particles in D dimensions, float64.

    Attributes:
        x, v: (N, D). F: (N, D, D). mass, volume, E: (N,).
        nu, dx, dt, gravity: numbers; gravity points down the last axis.
        nodes: of the grid, along each axis.
    """

    x: Array
    v: Array
    F: Array
    mass: Array
    volume: Array
    E: Array
    nu: float
    dx: float
    dt: float
    gravity: float
    nodes: tuple[int, ...]

    @property
    def dim(self) -> int:
        """The dimension."""
        return self.x.shape[1]


class Implementation(Protocol):
    """An implementation of the block."""

    def forward(self) -> None:
        """Run all substeps, and keep what the gradient needs."""

    def backward(self) -> None:
        """Run the adjoint of all substeps."""

    def results(self) -> Mapping[str, float]:
        """Return the loss and the norms of the gradients by velocity and by modulus, after forward and backward."""


def model_of(size: str, real: Any = np.float64) -> tuple[Model, Inputs]:
    """Return cqrun's model of a size in a precision: that of `cqrun bench`, with more substeps."""
    model, inputs = falling_block(*SIZES[size], real)
    return replace(model, substeps=SUBSTEPS), inputs


def block_of(size: str) -> Block:
    """Return the block of a size."""
    model, inputs = model_of(size)
    state, fields = inputs.state, inputs.fields
    E, nu = inputs.terms[0][0]
    nodes = tuple(int(n) for n in np.round(np.asarray(model.size) / model.dx).astype(int) + 4)
    return Block(
        np.array(state.x), np.array(state.v), np.array(state.F), np.array(fields.mass), np.array(fields.volume),
        np.array(E), float(nu[0]), model.dx, model.dt, float(-fields.force[0, -1] / fields.mass[0]), nodes,
    )  # fmt: skip

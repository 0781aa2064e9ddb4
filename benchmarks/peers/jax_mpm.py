"""The substep in JAX: whole arrays, scatter-add, one compiled function for the loss and one for its gradient."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from typing import Any

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers.problem import SUBSTEPS, Block

NEWTON = 5
"""Steps of R <- (R + R^-T) / 2 from R = F, in 3D."""


class Jax:
    """The block in arrays, and its compiled functions."""

    def __init__(self, block: Block) -> None:
        self.block = block
        self.start = tuple(jnp.asarray(a, jnp.float32) for a in (block.v, block.E))
        x, F, mass, volume = (jnp.asarray(a, jnp.float32) for a in (block.x, block.F, block.mass, block.volume))
        self.offsets = np.array(list(itertools.product(range(3), repeat=block.dim)))

        def loss(v: Any, E: Any) -> Any:
            state = (x, v, jnp.zeros_like(F), F)
            step = jax.checkpoint(lambda s, _: (self.substep(s, E, mass, volume), None))
            (final, *_), _ = jax.lax.scan(step, state, None, length=SUBSTEPS)
            return 0.5 * jnp.mean(jnp.sum(final * final, axis=1))

        self.loss = jax.jit(loss)
        self.gradient = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))

    def substep(self, state: Any, E: Any, mass: Any, volume: Any) -> Any:
        """Return (x, v, C, F) a substep later."""
        b, (x, v, C, F) = self.block, state
        mu, lam = E / (2 * (1 + b.nu)), E * b.nu / ((1 + b.nu) * (1 - 2 * b.nu))
        eye = jnp.eye(b.dim, dtype=x.dtype)
        J = jnp.linalg.det(F)
        tau = 2 * mu[:, None, None] * (F - rotation(F, b.dim)) @ jnp.swapaxes(F, 1, 2)
        tau = tau + (lam * (J - 1) * J)[:, None, None] * eye
        affine = mass[:, None, None] * C - (b.dt * 4 / b.dx**2) * volume[:, None, None] * tau
        base = jnp.floor(x / b.dx - 0.5).astype(jnp.int32)
        f = x / b.dx - base
        w = jnp.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])  # (3, N, D)
        weight = jnp.stack([jnp.prod(jnp.stack([w[o[d], :, d] for d in range(b.dim)]), axis=0) for o in self.offsets])
        node = base[None] + self.offsets[:, None]  # (K, N, D)
        away = (node - x / b.dx) * b.dx
        push = jnp.zeros_like(v).at[:, -1].set(-b.gravity * b.dt)
        momentum = weight[..., None] * (mass[:, None] * (v + push) + jnp.einsum("nij,knj->kni", affine, away))
        place = tuple(node[..., d] for d in range(b.dim))
        grid_m = jnp.zeros(b.nodes, x.dtype).at[place].add(weight * mass)
        grid_v = jnp.zeros((*b.nodes, b.dim), x.dtype).at[place].add(momentum)
        grid_v = grid_v / jnp.where(grid_m > 0, grid_m, 1)[..., None]
        seen = weight[..., None] * grid_v[place]
        v = seen.sum(axis=0)
        C = (4 / b.dx**2) * jnp.einsum("kni,knj->nij", seen, away)
        return x + b.dt * v, v, C, (eye + b.dt * C) @ F

    def forward(self) -> None:
        """Run all substeps."""
        self.value = self.loss(*self.start).block_until_ready()

    def backward(self) -> None:
        """Run all substeps and their adjoint, because JAX cannot run the adjoint alone."""
        self.value, self.gradients = jax.block_until_ready(self.gradient(*self.start))

    def results(self) -> Mapping[str, float]:
        """Return the loss and the norms of both gradients."""
        by_v, by_E = (np.asarray(g, np.float64) for g in self.gradients)
        return {"loss": float(self.value), "by_v": float(np.linalg.norm(by_v)), "by_E": float(np.linalg.norm(by_E))}


def rotation(F: Any, dim: int) -> Any:
    """Return the rotations of F (N, D, D): in closed form in 2D, by Newton's iteration in 3D."""
    if dim == 2:
        a, b = F[:, 0, 0] + F[:, 1, 1], F[:, 1, 0] - F[:, 0, 1]
        r = jnp.sqrt(a * a + b * b)
        c, s = a / r, b / r
        return jnp.stack([jnp.stack([c, -s], -1), jnp.stack([s, c], -1)], -2)
    R = F
    for _ in range(NEWTON):
        R = 0.5 * (R + jnp.swapaxes(jnp.linalg.inv(R), 1, 2))
    return R


def make(block: Block) -> Jax:
    """Return the implementation of a block."""
    return Jax(block)


BACKWARD_HOLDS_FORWARD = True
"""Whether `backward` also runs the substeps forward. If so, the time of `forward` is not added."""

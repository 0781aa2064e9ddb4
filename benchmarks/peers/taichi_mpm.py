"""The substep in Taichi on the CPU, as in DiffTaichi: kernels with generated adjoints, and grids computed again.

Without `from __future__ import annotations`: Taichi reads annotations as objects.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import taichi as ti

from benchmarks.peers.problem import SUBSTEPS, Block

NEWTON = 5
"""Steps of R <- (R + R^-T) / 2 from R = F, in 3D."""


@ti.data_oriented
class Taichi:
    """The block in fields for every substep, with one grid."""

    def __init__(self, block: Block) -> None:
        self.n, self.dim = len(block.x), block.dim
        self.nu, self.dx, self.dt, self.gravity = block.nu, block.dx, block.dt, block.gravity
        n, d, real = self.n, self.dim, ti.f32
        shape = (SUBSTEPS + 1, n)
        self.x = ti.Vector.field(d, real, shape, needs_grad=True)
        self.v = ti.Vector.field(d, real, shape, needs_grad=True)
        self.C = ti.Matrix.field(d, d, real, shape, needs_grad=True)
        self.F = ti.Matrix.field(d, d, real, shape, needs_grad=True)
        self.E = ti.field(real, n, needs_grad=True)
        self.mass, self.volume = ti.field(real, n), ti.field(real, n)
        self.grid_p = ti.Vector.field(d, real, block.nodes, needs_grad=True)
        self.grid_v = ti.Vector.field(d, real, block.nodes, needs_grad=True)
        self.grid_m = ti.field(real, block.nodes, needs_grad=True)
        self.loss = ti.field(real, (), needs_grad=True)
        for field, value in ((self.E, block.E), (self.mass, block.mass), (self.volume, block.volume)):
            field.from_numpy(value.astype(np.float32))
        starts = ((self.x, block.x), (self.v, block.v), (self.F, block.F))
        for field, value in starts:
            whole = np.zeros((SUBSTEPS + 1, *value.shape), np.float32)
            whole[0] = value
            field.from_numpy(whole)

    @ti.func
    def rotation(self, F: ti.template()):  # type: ignore[valid-type]
        R = F
        if ti.static(self.dim == 2):
            a, b = F[0, 0] + F[1, 1], F[1, 0] - F[0, 1]
            r = ti.sqrt(a * a + b * b)
            R = ti.Matrix([[a / r, -b / r], [b / r, a / r]])
        else:
            R1 = 0.5 * (F + F.inverse().transpose())
            R2 = 0.5 * (R1 + R1.inverse().transpose())
            R3 = 0.5 * (R2 + R2.inverse().transpose())
            R4 = 0.5 * (R3 + R3.inverse().transpose())
            R = 0.5 * (R4 + R4.inverse().transpose())
        return R

    @ti.kernel
    def clear(self):
        for node in ti.grouped(self.grid_m):
            self.grid_p[node] = ti.zero(self.grid_p[node])
            self.grid_v[node] = ti.zero(self.grid_v[node])
            self.grid_m[node] = 0
            self.grid_p.grad[node] = ti.zero(self.grid_p[node])
            self.grid_v.grad[node] = ti.zero(self.grid_v[node])
            self.grid_m.grad[node] = 0

    @ti.kernel
    def p2g(self, s: ti.i32):
        for p in range(self.n):
            base = ti.cast(self.x[s, p] / self.dx - 0.5, ti.i32)
            f = self.x[s, p] / self.dx - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
            mu = self.E[p] / (2 * (1 + self.nu))
            lam = self.E[p] * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))
            F = self.F[s, p]
            J = F.determinant()
            eye = ti.Matrix.identity(ti.f32, self.dim)
            tau = 2 * mu * (F - self.rotation(F)) @ F.transpose() + lam * (J - 1) * J * eye
            affine = self.mass[p] * self.C[s, p] - (self.dt * 4 / self.dx**2 * self.volume[p]) * tau
            momentum = self.mass[p] * self.v[s, p]
            momentum[self.dim - 1] -= self.mass[p] * self.gravity * self.dt
            for offset in ti.static(ti.grouped(ti.ndrange(*((3,) * self.dim)))):
                away = (ti.cast(offset, ti.f32) - f) * self.dx
                weight = 1.0
                for d in ti.static(range(self.dim)):
                    weight *= w[offset[d]][d]
                self.grid_p[base + offset] += weight * (momentum + affine @ away)
                self.grid_m[base + offset] += weight * self.mass[p]

    @ti.kernel
    def grid(self):
        for node in ti.grouped(self.grid_m):
            if self.grid_m[node] > 0:
                self.grid_v[node] = self.grid_p[node] / self.grid_m[node]

    @ti.kernel
    def g2p(self, s: ti.i32):
        for p in range(self.n):
            base = ti.cast(self.x[s, p] / self.dx - 0.5, ti.i32)
            f = self.x[s, p] / self.dx - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
            v = ti.Vector.zero(ti.f32, self.dim)
            C = ti.Matrix.zero(ti.f32, self.dim, self.dim)
            for offset in ti.static(ti.grouped(ti.ndrange(*((3,) * self.dim)))):
                away = (ti.cast(offset, ti.f32) - f) * self.dx
                weight = 1.0
                for d in ti.static(range(self.dim)):
                    weight *= w[offset[d]][d]
                seen = weight * self.grid_v[base + offset]
                v += seen
                C += 4 / self.dx**2 * seen.outer_product(away)
            self.v[s + 1, p] = v
            self.C[s + 1, p] = C
            self.x[s + 1, p] = self.x[s, p] + self.dt * v
            self.F[s + 1, p] = self.F[s, p] + self.dt * C @ self.F[s, p]

    @ti.kernel
    def measure(self):
        for p in range(self.n):
            self.loss[None] += 0.5 / self.n * self.x[SUBSTEPS, p].norm_sqr()

    @ti.kernel
    def clear_gradients(self):
        for s, p in self.x:
            self.x.grad[s, p] = ti.zero(self.x[s, p])
            self.v.grad[s, p] = ti.zero(self.v[s, p])
            self.C.grad[s, p] = ti.zero(self.C[s, p])
            self.F.grad[s, p] = ti.zero(self.F[s, p])
        for p in self.E:
            self.E.grad[p] = 0

    def forward(self) -> None:
        """Run all substeps and keep their states."""
        for s in range(SUBSTEPS):
            self.clear()
            self.p2g(s)
            self.grid()
            self.g2p(s)
        self.loss[None] = 0
        self.measure()
        ti.sync()

    def backward(self) -> None:
        """Run the adjoint of all substeps; the grid of each is computed again."""
        self.clear_gradients()
        self.loss.grad[None] = 1
        self.measure.grad()
        for s in reversed(range(SUBSTEPS)):
            self.clear()
            self.p2g(s)
            self.grid()
            self.g2p.grad(s)
            self.grid.grad()
            self.p2g.grad(s)
        ti.sync()

    def results(self) -> Mapping[str, float]:
        """Return the loss and the norms of both gradients."""
        by_v = self.v.grad.to_numpy()[0].astype(np.float64)
        by_E: Any = self.E.grad.to_numpy().astype(np.float64)
        loss = float(self.loss[None])
        return {"loss": loss, "by_v": float(np.linalg.norm(by_v)), "by_E": float(np.linalg.norm(by_E))}


def make(block: Block) -> Taichi:
    """Return the implementation of a block."""
    ti.init(arch=ti.cpu, default_fp=ti.f32, cpu_max_num_threads=1, log_level=ti.ERROR, offline_cache=True)
    return Taichi(block)


BACKWARD_HOLDS_FORWARD = False
"""Whether `backward` also runs the substeps forward. If so, the time of `forward` is not added."""

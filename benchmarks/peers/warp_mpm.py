"""The substep in NVIDIA Warp on the CPU: kernels over particles and nodes, with adjoints from a tape."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from benchmarks.peers.problem import SUBSTEPS, Block

wp.config.quiet = True
NEWTON = wp.constant(5)
"""Steps of R <- (R + R^-T) / 2 from R = F, in 3D."""


@wp.func
def rotation2(F: wp.mat22) -> wp.mat22:
    a = F[0, 0] + F[1, 1]
    b = F[1, 0] - F[0, 1]
    r = wp.sqrt(a * a + b * b)
    c = a / r
    s = b / r
    return wp.mat22(c, -s, s, c)


@wp.func
def improved(R: wp.mat33) -> wp.mat33:
    return 0.5 * (R + wp.transpose(wp.inverse(R)))


@wp.func
def rotation3(F: wp.mat33) -> wp.mat33:
    # no loop: a loop that overwrites R would lose what its adjoint needs
    R1 = improved(F)
    R2 = improved(R1)
    R3 = improved(R2)
    R4 = improved(R3)
    return improved(R4)


@wp.func
def spline(f: float, k: int) -> float:
    w = 0.5 * (1.5 - f) * (1.5 - f)
    if k == 1:
        w = 0.75 - (f - 1.0) * (f - 1.0)
    if k == 2:
        w = 0.5 * (f - 0.5) * (f - 0.5)
    return w


@wp.kernel
def p2g2(
    x: wp.array(dtype=wp.vec2), v: wp.array(dtype=wp.vec2), C: wp.array(dtype=wp.mat22), F: wp.array(dtype=wp.mat22),
    E: wp.array(dtype=float), mass: wp.array(dtype=float), volume: wp.array(dtype=float), nu: float, dx: float,
    dt: float, gravity: float, grid_v: wp.array2d(dtype=wp.vec2), grid_m: wp.array2d(dtype=float),
):  # fmt: skip
    p = wp.tid()
    mu = E[p] / (2.0 * (1.0 + nu))
    lam = E[p] * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    J = wp.determinant(F[p])
    tau = 2.0 * mu * ((F[p] - rotation2(F[p])) * wp.transpose(F[p])) + wp.diag(wp.vec2(lam * (J - 1.0) * J))
    affine = mass[p] * C[p] - (dt * 4.0 / (dx * dx) * volume[p]) * tau
    momentum = mass[p] * (v[p] + wp.vec2(0.0, -gravity * dt))
    bx = int(wp.floor(x[p][0] / dx - 0.5))
    by = int(wp.floor(x[p][1] / dx - 0.5))
    fx = x[p][0] / dx - float(bx)
    fy = x[p][1] / dx - float(by)
    for i in range(3):
        for j in range(3):
            w = spline(fx, i) * spline(fy, j)
            away = wp.vec2((float(i) - fx) * dx, (float(j) - fy) * dx)
            wp.atomic_add(grid_v, bx + i, by + j, w * (momentum + affine * away))
            wp.atomic_add(grid_m, bx + i, by + j, w * mass[p])


@wp.kernel
def grid2(momentum: wp.array2d(dtype=wp.vec2), m: wp.array2d(dtype=float), out: wp.array2d(dtype=wp.vec2)):
    i, j = wp.tid()
    if m[i, j] > 0.0:
        out[i, j] = momentum[i, j] / m[i, j]


@wp.kernel
def g2p2(
    x: wp.array(dtype=wp.vec2), F: wp.array(dtype=wp.mat22), grid_v: wp.array2d(dtype=wp.vec2), dx: float, dt: float,
    x_next: wp.array(dtype=wp.vec2), v_next: wp.array(dtype=wp.vec2), C_next: wp.array(dtype=wp.mat22),
    F_next: wp.array(dtype=wp.mat22),
):  # fmt: skip
    p = wp.tid()
    bx = int(wp.floor(x[p][0] / dx - 0.5))
    by = int(wp.floor(x[p][1] / dx - 0.5))
    fx = x[p][0] / dx - float(bx)
    fy = x[p][1] / dx - float(by)
    v = wp.vec2()
    C = wp.mat22()
    for i in range(3):
        for j in range(3):
            w = spline(fx, i) * spline(fy, j)
            away = wp.vec2((float(i) - fx) * dx, (float(j) - fy) * dx)
            seen = w * grid_v[bx + i, by + j]
            v += seen
            C += wp.outer(seen, away) * (4.0 / (dx * dx))
    v_next[p] = v
    C_next[p] = C
    x_next[p] = x[p] + dt * v
    F_next[p] = F[p] + dt * (C * F[p])


@wp.kernel
def p2g3(
    x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), C: wp.array(dtype=wp.mat33), F: wp.array(dtype=wp.mat33),
    E: wp.array(dtype=float), mass: wp.array(dtype=float), volume: wp.array(dtype=float), nu: float, dx: float,
    dt: float, gravity: float, grid_v: wp.array3d(dtype=wp.vec3), grid_m: wp.array3d(dtype=float),
):  # fmt: skip
    p = wp.tid()
    mu = E[p] / (2.0 * (1.0 + nu))
    lam = E[p] * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    J = wp.determinant(F[p])
    tau = 2.0 * mu * ((F[p] - rotation3(F[p])) * wp.transpose(F[p])) + wp.diag(wp.vec3(lam * (J - 1.0) * J))
    affine = mass[p] * C[p] - (dt * 4.0 / (dx * dx) * volume[p]) * tau
    momentum = mass[p] * (v[p] + wp.vec3(0.0, 0.0, -gravity * dt))
    bx = int(wp.floor(x[p][0] / dx - 0.5))
    by = int(wp.floor(x[p][1] / dx - 0.5))
    bz = int(wp.floor(x[p][2] / dx - 0.5))
    fx = x[p][0] / dx - float(bx)
    fy = x[p][1] / dx - float(by)
    fz = x[p][2] / dx - float(bz)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                w = spline(fx, i) * spline(fy, j) * spline(fz, k)
                away = wp.vec3((float(i) - fx) * dx, (float(j) - fy) * dx, (float(k) - fz) * dx)
                wp.atomic_add(grid_v, bx + i, by + j, bz + k, w * (momentum + affine * away))
                wp.atomic_add(grid_m, bx + i, by + j, bz + k, w * mass[p])


@wp.kernel
def grid3(momentum: wp.array3d(dtype=wp.vec3), m: wp.array3d(dtype=float), out: wp.array3d(dtype=wp.vec3)):
    i, j, k = wp.tid()
    if m[i, j, k] > 0.0:
        out[i, j, k] = momentum[i, j, k] / m[i, j, k]


@wp.kernel
def g2p3(
    x: wp.array(dtype=wp.vec3), F: wp.array(dtype=wp.mat33), grid_v: wp.array3d(dtype=wp.vec3), dx: float, dt: float,
    x_next: wp.array(dtype=wp.vec3), v_next: wp.array(dtype=wp.vec3), C_next: wp.array(dtype=wp.mat33),
    F_next: wp.array(dtype=wp.mat33),
):  # fmt: skip
    p = wp.tid()
    bx = int(wp.floor(x[p][0] / dx - 0.5))
    by = int(wp.floor(x[p][1] / dx - 0.5))
    bz = int(wp.floor(x[p][2] / dx - 0.5))
    fx = x[p][0] / dx - float(bx)
    fy = x[p][1] / dx - float(by)
    fz = x[p][2] / dx - float(bz)
    v = wp.vec3()
    C = wp.mat33()
    for i in range(3):
        for j in range(3):
            for k in range(3):
                w = spline(fx, i) * spline(fy, j) * spline(fz, k)
                away = wp.vec3((float(i) - fx) * dx, (float(j) - fy) * dx, (float(k) - fz) * dx)
                seen = w * grid_v[bx + i, by + j, bz + k]
                v += seen
                C += wp.outer(seen, away) * (4.0 / (dx * dx))
    v_next[p] = v
    C_next[p] = C
    x_next[p] = x[p] + dt * v
    F_next[p] = F[p] + dt * (C * F[p])


@wp.kernel
def loss2(x: wp.array(dtype=wp.vec2), scale: float, out: wp.array(dtype=float)):
    wp.atomic_add(out, 0, scale * wp.dot(x[wp.tid()], x[wp.tid()]))


@wp.kernel
def loss3(x: wp.array(dtype=wp.vec3), scale: float, out: wp.array(dtype=float)):
    wp.atomic_add(out, 0, scale * wp.dot(x[wp.tid()], x[wp.tid()]))


class Warp:
    """The block in arrays for every substep, as a tape needs them."""

    def __init__(self, block: Block) -> None:
        self.block, n, d = block, len(block.x), block.dim
        vec, mat = (wp.vec2, wp.mat22) if d == 2 else (wp.vec3, wp.mat33)
        self.kernels: tuple[Any, ...] = (p2g2, grid2, g2p2, loss2) if d == 2 else (p2g3, grid3, g2p3, loss3)

        def zeros(shape: Any, kind: Any) -> Any:
            return wp.zeros(shape, dtype=kind, requires_grad=True)

        self.states = [[zeros(n, vec), zeros(n, vec), zeros(n, mat), zeros(n, mat)] for _ in range(SUBSTEPS + 1)]
        start = (block.x, block.v, np.zeros_like(block.F), block.F)
        for array, value in zip(self.states[0], start, strict=True):
            array.assign(value.astype(np.float32))
        self.E = wp.array(block.E.astype(np.float32), dtype=float, requires_grad=True)
        self.mass, self.volume = (wp.array(a.astype(np.float32), dtype=float) for a in (block.mass, block.volume))
        self.grids = [
            (zeros(block.nodes, vec), zeros(block.nodes, float), zeros(block.nodes, vec)) for _ in range(SUBSTEPS)
        ]
        self.loss = zeros(1, float)
        self.n = n

    def forward(self) -> None:
        """Run all substeps, and record them on a tape."""
        b = self.block
        p2g, grid, g2p, loss = self.kernels
        self.tape = wp.Tape()
        self.loss.zero_()
        for momentum, m, out in self.grids:
            momentum.zero_()
            m.zero_()
            out.zero_()
        with self.tape:
            for k, (momentum, m, out) in enumerate(self.grids):
                x, v, C, F = self.states[k]
                material = [self.E, self.mass, self.volume, b.nu, b.dx, b.dt, b.gravity]
                wp.launch(p2g, self.n, inputs=[x, v, C, F, *material], outputs=[momentum, m], device="cpu")
                wp.launch(grid, b.nodes, inputs=[momentum, m], outputs=[out], device="cpu")
                wp.launch(g2p, self.n, inputs=[x, F, out, b.dx, b.dt], outputs=self.states[k + 1], device="cpu")
            wp.launch(loss, self.n, inputs=[self.states[-1][0], 0.5 / self.n], outputs=[self.loss], device="cpu")

    def backward(self) -> None:
        """Run the tape backward. Gradients of an earlier tape are cleared first."""
        for array in (self.E, self.loss, *(a for held in (*self.states, *self.grids) for a in held)):
            array.grad.zero_()
        self.tape.backward(self.loss)

    def results(self) -> Mapping[str, float]:
        """Return the loss and the norms of both gradients."""
        by_v, by_E = (np.asarray(a.grad.numpy(), np.float64) for a in (self.states[0][1], self.E))
        loss = float(self.loss.numpy()[0])
        return {"loss": loss, "by_v": float(np.linalg.norm(by_v)), "by_E": float(np.linalg.norm(by_E))}


def make(block: Block) -> Warp:
    """Return the implementation of a block."""
    wp.init()
    return Warp(block)


BACKWARD_HOLDS_FORWARD = False
"""Whether `backward` also runs the substeps forward. If so, the time of `forward` is not added."""

"""Compute how bodies move at the start: v and C of their particles, from `velocity` and `spin`.

A body starts as a rigid body moves: v(x) = v_0 + A (x - c), with A = [spin]x and c the mean of its particles. The
transfers keep such a field if each particle's affine matrix is its gradient, C_p = A, because then the nodes get

    sum_p w m (v_p + C_p (x_n - x_p)) = m_n v(x_n).

With C_p = 0 each node would get the mean velocity of its particles. After its first substep a body would turn more
slowly than its scene says.
"""

from __future__ import annotations

import numpy as np

from cqrun.build.particles import Particles
from cqrun.build.values import Values, collect, numbers
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene


class InitialMotion:
    """The map from velocities and spins to the motion of all particles, and its adjoint.

    Args:
        scene: the scene.
        particles: the particles of the scene.
    """

    def __init__(self, scene: Scene, particles: Particles) -> None:
        self.scene, self.particles, self.rotations = scene, particles, rotations(scene.dim)

    def at_start(self, x: Array, values: Values) -> tuple[Array, Array]:
        """Return v (N, D) [m/s] and C (N, D, D) [1/s] of particles at x (N, D) [m]."""
        v, C = np.zeros(x.shape), np.zeros((*x.shape, x.shape[1]))
        for body in self.particles.names:
            part = self.particles.of(body)
            v[part], C[part] = self.of_body(body, x, values)
        return v, C

    def of_body(self, body: str, x: Array, values: Values) -> tuple[Array, Array]:
        """Return v (N_b, D) of a body's particles, and their C (D, D), for all particles at x (N, D)."""
        base, A = f"bodies.{body}", self._velocity_gradient(body, values)
        v = numbers(f"{base}.velocity", self.scene.bodies[body].velocity, values)
        return v + self._arms(body, x) @ A.T, A

    def at_start_vjp(self, x: Array, values: Values, v_bar: Array, C_bar: Array, out: dict[str, Array]) -> Array:
        """Add to the gradients in `out`; return the cotangent of the positions (N, D)."""
        x_bar = np.zeros(x.shape)
        for body in self.particles.names:
            part, A = self.particles.of(body), self._velocity_gradient(body, values)
            A_bar = np.einsum("nd,ne->de", v_bar[part], self._arms(body, x)) + C_bar[part].sum(axis=0)
            spin_bar = np.einsum("sde,de->s", self.rotations, A_bar)
            collect(f"bodies.{body}", {"velocity": v_bar[part].sum(axis=0), "spin": spin_bar}, out)
            arms_bar = v_bar[part] @ A
            x_bar[part] = arms_bar - arms_bar.mean(axis=0)
        return x_bar

    def _velocity_gradient(self, body: str, values: Values) -> Array:
        """Return A = [spin]x of a body (D, D) [1/s]."""
        spin = numbers(f"bodies.{body}.spin", self.scene.bodies[body].spin, values)
        return np.einsum("s,sde->de", spin, self.rotations) + 0.0  # -0 becomes 0

    def _arms(self, body: str, x: Array) -> Array:
        """Return x - c of a body's particles (N_b, D) [m]."""
        x_body = x[self.particles.of(body)]
        return np.asarray(x_body - x_body.mean(axis=0))


def rotations(dim: int) -> Array:
    """Return the velocity gradients of unit spins, one about z in 2D or about each axis in 3D (1 or 3, D, D)."""
    if dim == 2:
        return np.array([[[0.0, -1.0], [1.0, 0.0]]])
    axes = np.eye(3)
    return np.cross(axes[:, None, :], axes[None, :, :]).transpose(0, 2, 1)  # column j is axis x e_j

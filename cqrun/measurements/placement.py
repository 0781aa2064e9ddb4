"""Where the axes of a recording lie in those of the scene: z = R(r) y + c, with a rotation vector r and an offset c.

Turned by a small angle phi more, z changes by phi x (z - c). The rotation vector changes it by phi = J dr, with

    J = I + a [r]x + b [r]x^2,  a = (1 - cos t) / t^2,  b = (t - sin t) / t^3,  t = |r|

the left Jacobian of SO(3) (Barfoot, State Estimation for Robotics (2017), eq. 7.77a).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array

PLACED = ("offset", "rotation")
"""The fields of a recording that place its positions."""

SMALL = 1e-2
"""Below this angle [rad], a and b are taken from their series: the next term is less than 1e-13 of them."""


@dataclass(frozen=True)
class Placement:
    """A rigid motion of measured positions.

    Attributes:
        offset: c (D,) [m].
        rotation: r, about the origin of the file: an angle (1,) in 2D, a rotation vector (3,) in 3D [rad].
    """

    offset: Array
    rotation: Array

    @classmethod
    def none(cls, dim: int) -> Placement:
        """Return the one that leaves positions where they are."""
        return cls(np.zeros(dim), np.zeros(1 if dim == 2 else 3))

    def __bool__(self) -> bool:
        """Return whether it moves anything."""
        return bool(self.offset.any() or self.rotation.any())

    @property
    def matrix(self) -> Array:
        """The rotation matrix R (D, D)."""
        if len(self.rotation) == 1:
            cosine, sine = np.cos(self.rotation[0]), np.sin(self.rotation[0])
            return np.array([[cosine, -sine], [sine, cosine]])
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_rotvec(self.rotation).as_matrix())

    def of(self, y: Array) -> Array:
        """Return where positions (..., D) are in the axes of the scene."""
        return np.asarray((y @ self.matrix.T if self.rotation.any() else y) + self.offset)

    def vjp(self, z: Array, z_bar: Array) -> Placement:
        """Return its cotangent from positions in the axes of the scene (..., D) and their cotangents."""
        arm, dim = z - self.offset, z.shape[-1]
        offset_bar = z_bar.reshape(-1, dim).sum(axis=0)
        if dim == 2:
            turn_bar = np.sum(arm[..., 0] * z_bar[..., 1] - arm[..., 1] * z_bar[..., 0])
            return Placement(offset_bar, np.array([turn_bar]))
        phi_bar = np.cross(arm, z_bar).reshape(-1, 3).sum(axis=0)
        r, t = self.rotation, float(np.linalg.norm(self.rotation))
        if t < SMALL:
            a, b = 0.5 - t**2 / 24.0 + t**4 / 720.0, 1.0 / 6.0 - t**2 / 120.0 + t**4 / 5040.0
        else:
            a, b = (1.0 - np.cos(t)) / t**2, (t - np.sin(t)) / t**3
        once = np.cross(r, phi_bar)
        return Placement(offset_bar, phi_bar - a * once + b * np.cross(r, once))  # J^T, as [r]x^T = -[r]x

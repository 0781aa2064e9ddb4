"""Where local coordinates lie in the world: world = offset + scale * R * local, R a rotation."""

from __future__ import annotations

import numpy as np

from cqrun.boundaries.solid import Solid
from cqrun.explain import Loc
from cqrun.plugin.contract import Array, Spec, quantity, vector


class Place(Spec):
    """A similarity: world = offset + scale * rotation * local."""

    scale: float = quantity("1", "World length of one unit of local length", gt=0, default=1.0, geometric=True)
    offset: list[float] | None = vector(
        "m", "World position of the local origin; zero if absent", geometric=True, default=None
    )
    angle: float | None = quantity(
        "deg", "Counterclockwise rotation about the local origin (2D)", geometric=True, default=None
    )
    rotation: list[float] | None = quantity(
        "deg", "Rotation vector about the local origin: its length is the angle (3D)",
        geometric=True, min_length=3, max_length=3, default=None,
    )  # fmt: skip

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems = super().dim_problems(dim)
        if dim == 3 and self.angle is not None:
            problems.append((("angle",), "is for a 2D world; in 3D give `rotation`: [x, y, z] in degrees"))
        if dim == 2 and self.rotation is not None:
            problems.append((("rotation",), "is for a 3D world; in 2D give `angle` in degrees"))
        return problems

    def matrix(self, dim: int) -> Array:
        """Return the rotation matrix (dim, dim), complex if the angles are; multiples of 90 degrees are exact."""
        if self.angle:
            angle = self.angle * (np.pi / 180)
            R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        elif self.rotation and any(np.iscomplex(self.rotation)):
            from scipy.linalg import expm

            return np.asarray(expm(np.cross(np.eye(3), np.array(self.rotation) * (np.pi / 180))))
        elif self.rotation and any(self.rotation):
            from scipy.spatial.transform import Rotation

            R = Rotation.from_rotvec(self.rotation, degrees=True).as_matrix()
        else:
            return np.eye(dim)
        return np.where(np.abs(R) < 1e-15, 0.0, R) if np.isrealobj(R) else R

    def to_world(self, points: Array) -> Array:
        """Return the world coordinates (N, D) [m] of local points (N, D)."""
        return self._origin() + self.scale * self._turned(points, self.matrix(points.shape[1]))

    def to_local(self, points: Array) -> Array:
        """Return the local coordinates (N, D) of points (N, D) [m] of the world."""
        return self._turned((points - self._origin()) / self.scale, self.matrix(points.shape[1]).T)

    def world_bounds(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return the world corners (D,) [m] of a box around a local box, which may be infinite."""
        R = self.matrix(len(lower))
        # 0 * inf is nan, so axes with a zero entry are omitted
        ends = [np.multiply(R, end, out=np.zeros_like(R), where=R != 0) for end in (lower, upper)]
        low, high = np.minimum(*ends).sum(axis=1), np.maximum(*ends).sum(axis=1)
        return self._origin() + self.scale * low, self._origin() + self.scale * high

    def solid_to_world(self, solid: Solid) -> Solid:
        """Return a solid of local coordinates in those of the world."""
        dim = solid.points.shape[1]
        return solid.placed(self.scale, self.matrix(dim), np.zeros(dim) + self._origin())

    def _turned(self, points: Array, R: Array) -> Array:
        """Return R x of points (N, D); without a rotation they are returned unchanged."""
        return points @ R.T if self.angle or self.rotation else points

    def _origin(self) -> Array | float:
        return 0.0 if self.offset is None else np.array(self.offset)

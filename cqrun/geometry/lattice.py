"""Particles on a regular lattice."""

from __future__ import annotations

import numpy as np

from cqrun.contract import Array
from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import Shape, lattice_points
from cqrun.registry import plugin


@plugin("sampling", "lattice")
class Lattice(Sampling):
    """A particle at (k + 1/2) * spacing from the shape's lower corner, k whole; volume spacing^D each."""

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        assert spacing is not None
        points = lattice_points(shape, spacing)
        return points, np.full(len(points), spacing ** points.shape[1])

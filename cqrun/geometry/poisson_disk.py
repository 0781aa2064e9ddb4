"""Particles at random places with a minimum distance."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import Shape, finite_bounds
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

NEAREST = {2: 0.78, 3: 0.84}
"""Minimum distance in spacings, by dimension, at which there is about one particle in spacing^D (measured)."""

MOST = 15_000
"""Largest number of particles over the bounds of a shape; SciPy makes about a thousand in a second."""


@plugin("sampling", "poisson_disk")
class PoissonDisk(Sampling):
    """Particles at random places, at least 0.78 (3D: 0.84) spacings apart: about as many as on a lattice.

    Unlike a lattice they have no preferred axes. The volume of each is the shape's volume divided by their number. This
    is slow: use `jittered` for more than about 10,000 particles.
    """

    seed: int = Field(description="Seed of the random places", ge=0, default=0)

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        from scipy.stats.qmc import PoissonDisk as Filler

        assert spacing is not None
        lower, upper = finite_bounds(shape)
        expected = float(np.prod((upper - lower) / spacing))
        if expected > MOST:
            raise UsageError(
                f"about {expected:.3g} particles around the {shape.name} are too many for poisson_disk sampling, "
                f"which makes a thousand in a second and stops at {MOST:,}; use `jittered`"
            )
        rng = np.random.default_rng(self.seed)
        radius = NEAREST[len(lower)] * spacing
        points = Filler(len(lower), radius=radius, rng=rng, l_bounds=lower, u_bounds=upper).fill_space()
        points = points[shape.inside(points)]
        return points, np.full(len(points), shape.volume() / max(1, len(points)))

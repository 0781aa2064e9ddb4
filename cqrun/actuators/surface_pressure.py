"""A pressure on a patch of a body's surface, which it follows: f_a = f_b = f_c = p N / 6 (`forces/wall.py`).

N points into the body. A patch has a rim, at which the force depends on the way, so it has no potential and its tangent
is not symmetric: with the displacements d of a facet's points,

    df_a = df_b = df_c = p / 6 ((d_b - d_a) x (c - a) + (b - a) x (d_c - d_a)).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from cqrun.actuators.actuator import Actuator
from cqrun.actuators.chamber import swell, swell_vjp
from cqrun.errors import UsageError
from cqrun.forces.force import Inside, Levels, Riding, Shares, Skin, register_force
from cqrun.forces.wall import each_facet, press_facet_jvp, wall_constants
from cqrun.numerics.compile import kernel
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin, quantity
from cqrun.plugin.registry import plugin


class PatchKernel(NamedTuple):
    """All facets of a scene's patches under pressure; each is an item."""

    shares: Shares
    parts: Array
    constants: Array  # (I, 0)


@plugin("actuator", "surface_pressure")
class SurfacePressure(Actuator):
    """A pressure on a patch of a body's surface, from outside; it follows the surface.

    The patch consists of the facets of the surface whose middle is in the region. A cavity is better a `chamber`,
    which is closed, and so has a potential.
    """

    region: Annotated[Chosen[Plugin], Choice("region")] = Field(description="Where the patch is at rest")
    pressure: float = quantity("Pa", "Pressure at activation 1; suction if negative", differentiable=True)

    scale = "pressure"
    kernel = PatchKernel
    frame = "reference"

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and largest activation."""
        return 0.0, 1.0

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles of its body."""
        return inside(self.body, None)

    def constants(self, x: Array) -> Array:
        """Return nothing: `riding` has them."""
        return np.zeros(0)

    def riding(self, part: str, skin: Callable[[], Skin]) -> Riding:
        """Return the points of the patch; UsageError if there is none."""
        surface = skin()
        middle = surface.x[surface.facets].mean(axis=1)
        chosen = surface.facets[surface.pick(self.region, middle, surface.particle[surface.facets[:, 0]])]
        if not len(chosen):
            raise UsageError(
                f"no part of the surface of '{self.body}' lies in the region: enlarge it, or move it there"
            )
        points, facets = np.unique(chosen[:, ::-1], return_inverse=True)
        return Riding(surface.particle[points], surface.x[points], wall_constants(facets.reshape(chosen.shape)))

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness against the turning of facets, about 4 p times their size [N/m]."""
        size = float(cKDTree(x).query(x, 2)[0][:, 1].max())
        return 4.0 * abs(strength) * size ** (x.shape[1] - 2)


@kernel
def weigh_jvp(patches: PatchKernel, item: int, levels: Levels, control: int, q: Array, move: Array) -> None:
    """Write how the shares change with a displacement of the points."""
    a = patches.parts[item]
    pressure = levels.activation[control, a] * levels.strength[a]
    press_facet_jvp(patches.shares, patches.shares.begin[item], pressure, q, move)


register_force(PatchKernel, each_facet, swell, swell_vjp, rate=False, own=slice(0, 0), exert_jvp=weigh_jvp)

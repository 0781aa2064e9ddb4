"""Count the grid cells and the particles across the thinnest part of each body."""

from __future__ import annotations

from cqrun.build.model import Built
from cqrun.store.thinnest import Thinnest


def thinnest_parts(built: Built) -> dict[str, Thinnest]:
    """Return thickness, cells and particles across the thinnest part of each body by name."""
    found = {}
    for name, raster in built.rasters.items():
        thickness, dx, spacing = raster.thickness, built.scene.world.dx, built.particles.spacing[name]
        cells, particles = float(thickness / dx), float(thickness / spacing)
        found[name] = Thinnest(thickness=float(thickness), cells=cells, particles=particles)
    return found

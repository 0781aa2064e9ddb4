"""A thick ring under inner pressure: plane strain, small strains (Lame 1852; Timoshenko and Goodier 1970, art. 28)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class Ring:
    """A ring a <= r <= b [m] of modulus E [Pa] and Poisson's ratio nu, under the pressure p [Pa] at r = a."""

    inner: float
    outer: float
    youngs_modulus: float
    poissons_ratio: float
    pressure: float

    def displacement(self, r: Array | float) -> Array:
        """Return the outward displacement [m] at radius r [m]."""
        nu = self.poissons_ratio
        factor = (1.0 + nu) / self.youngs_modulus * self._core
        return np.asarray(factor * ((1.0 - 2.0 * nu) * np.asarray(r) + self.outer**2 / np.asarray(r)))

    def radial_stress(self, r: Array | float) -> Array:
        """Return the radial stress [Pa] at radius r [m]: -p at r = a, and zero at r = b."""
        return np.asarray(self._core * (1.0 - self.outer**2 / np.asarray(r) ** 2))

    def hoop_stress(self, r: Array | float) -> Array:
        """Return the stress along the circumference [Pa] at radius r [m]."""
        return np.asarray(self._core * (1.0 + self.outer**2 / np.asarray(r) ** 2))

    @property
    def _core(self) -> float:
        return self.pressure * self.inner**2 / (self.outer**2 - self.inner**2)


EXAMPLE = Ring(inner=0.02, outer=0.04, youngs_modulus=3.0e5, poissons_ratio=0.45, pressure=300.0)
"""The ring of the convergence tables: p = E / 1000."""

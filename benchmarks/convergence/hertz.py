"""Frictionless contact of an elastic disc (plane strain) or ball with a rigid plane (Hertz 1882; Johnson 1985, ch. 4).

Valid while the half-width or radius of the contact is much smaller than the radius of the body. E* = E / (1 - nu^2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class LineContact:
    """A disc of radius R [m] pressed on a rigid plane by a force P per width [N/m]."""

    radius: float
    youngs_modulus: float
    poissons_ratio: float
    force: float

    @property
    def half_width(self) -> float:
        """The half-width a of the contact [m]: a^2 = 4 P R / (pi E*)."""
        return float(np.sqrt(4.0 * self.force * self.radius / (np.pi * self._modulus)))

    @property
    def peak_pressure(self) -> float:
        """The largest pressure [Pa]: 2 P / (pi a)."""
        return 2.0 * self.force / (np.pi * self.half_width)

    def pressure(self, x: Array) -> Array:
        """Return the pressure [Pa] at a distance x [m] from the middle of the contact."""
        return self.peak_pressure * np.sqrt(np.maximum(1.0 - (np.asarray(x) / self.half_width) ** 2, 0.0))

    @property
    def approach(self) -> float:
        """How far the disc's centre comes nearer to the plane [m], with the load on the far side (Johnson 1985, 5.57).

        A disc between two rigid planes is compressed by twice as much. In 2D this depends on the size of the body, and
        on where its other load acts.
        """
        logarithm = 2.0 * np.log(4.0 * self.radius / self.half_width) - 1.0
        return float(self.force / (np.pi * self._modulus) * logarithm)

    @property
    def _modulus(self) -> float:
        return self.youngs_modulus / (1.0 - self.poissons_ratio**2)


@dataclass(frozen=True)
class BallContact:
    """A ball of radius R [m] pressed on a rigid plane by a force P [N]."""

    radius: float
    youngs_modulus: float
    poissons_ratio: float
    force: float

    @property
    def contact_radius(self) -> float:
        """The radius a of the contact [m]: a^3 = 3 P R / (4 E*)."""
        return float(np.cbrt(0.75 * self.force * self.radius / self._modulus))

    @property
    def peak_pressure(self) -> float:
        """The largest pressure [Pa]: 3 P / (2 pi a^2)."""
        return 1.5 * self.force / (np.pi * self.contact_radius**2)

    def pressure(self, r: Array) -> Array:
        """Return the pressure [Pa] at a distance r [m] from the middle of the contact."""
        return self.peak_pressure * np.sqrt(np.maximum(1.0 - (np.asarray(r) / self.contact_radius) ** 2, 0.0))

    @property
    def approach(self) -> float:
        """How far the ball's far parts come nearer to the plane [m]: a^2 / R."""
        return self.contact_radius**2 / self.radius

    @property
    def _modulus(self) -> float:
        return self.youngs_modulus / (1.0 - self.poissons_ratio**2)

"""Cylinders (plane strain) and balls with a hole, under inner pressure: small strains, and incompressible rubber.

Lame's solutions: Timoshenko and Goodier 1970, articles 28 and 142. Large strains: of an incompressible body r^n - R^n
is the same everywhere (n = 2, 3), so the stretch around it, s = r / R, is known. Equilibrium along the radius gives

    p = integral from r(A) to r(B) of (n - 1) (sigma_around - sigma_radial) / r dr,    sigma = mu (s^2 - s^(2 - 2n)),

with mu of a neo-Hookean law (Ogden, Non-linear Elastic Deformations, 1984, sections 5.3.1 and 5.3.4).
"""

from __future__ import annotations

from dataclasses import dataclass

from scipy.integrate import quad
from scipy.optimize import minimize_scalar


@dataclass(frozen=True)
class Vessel:
    """A <= R <= B [m], of modulus E [Pa] and Poisson's ratio nu; a cylinder in 2D, a ball in 3D."""

    dim: int
    inner: float
    outer: float
    youngs_modulus: float
    poissons_ratio: float

    def small(self, pressure: float) -> float:
        """Return r / R at the inner surface under a small pressure [Pa]."""
        a, b, E, nu = self.inner, self.outer, self.youngs_modulus, self.poissons_ratio
        if self.dim == 2:
            return 1.0 + (1.0 + nu) / E * pressure * ((1.0 - 2.0 * nu) * a**2 + b**2) / (b**2 - a**2)
        return 1.0 + pressure / E * ((1.0 - 2.0 * nu) * a**3 + 0.5 * (1.0 + nu) * b**3) / (b**3 - a**3)

    def pressure(self, stretch: float) -> float:
        """Return the pressure [Pa] at which r / R is `stretch` at the inner surface of incompressible rubber."""
        n, mu = self.dim, self.youngs_modulus / 3.0
        gained = (stretch**n - 1.0) * self.inner**n

        def along(R: float) -> float:
            r = (R**n + gained) ** (1.0 / n)
            s = r / R
            return float((n - 1) * mu * (s**2 - s ** (2 - 2 * n)) * R ** (n - 1) / r**n)

        return float(quad(along, self.inner, self.outer, epsrel=1e-10)[0])

    def limit(self) -> tuple[float, float]:
        """Return the stretch at the inner surface and the pressure [Pa] at a ball's limit point."""
        found = minimize_scalar(lambda s: -self.pressure(s), bounds=(1.0, 4.0), method="bounded")
        return float(found.x), -float(found.fun)


def closed_tube(inner: float, outer: float, youngs_modulus: float, poissons_ratio: float, pressure: float) -> float:
    """Return the axial strain of a long straight tube with closed ends, under a small inner pressure [Pa].

    The ends pull with p a^2 / (b^2 - a^2), and the sums of the other two stresses are twice that (Lame).
    """
    return pressure * inner**2 / (outer**2 - inner**2) * (1.0 - 2.0 * poissons_ratio) / youngs_modulus

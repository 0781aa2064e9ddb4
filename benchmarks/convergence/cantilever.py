"""The clamped beam of the convergence tables as a finite-element problem: its first frequency, and its sag.

The beam occupies 0 <= x <= L, 0 <= z <= H and, in 3D, |y| <= W/2. It is clamped at x = 0, and gravity acts along -z.
In 2D (axes x, z) it is in plane strain. In 3D the half y >= 0 is solved, with u_y = 0 on the plane y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.convergence.elements import Elements, Material, graded, graded_to_both_ends
from benchmarks.convergence.equilibrium import Held
from cqrun.plugin.contract import Array

LENGTH, HEIGHT, WIDTH = 0.10, 0.03, 0.03
"""L, H, W [m]."""

STANDARD_GRAVITY = 9.81
"""One g [m/s^2]."""

GRADING = 2.0
"""Power of the grading towards the clamp and the surfaces, where the stress is singular or changes quickly."""


@dataclass(frozen=True)
class Tip:
    """Displacement of the end x = L [m]: mean over the end face, and at its centre (on the centre line)."""

    mean: Array
    centre: Array


class Cantilever:
    """The beam on one mesh.

    Args:
        dim: 2 or 3.
        counts: elements along the length, through the height (even) and, in 3D, through half the width.
        material: its material.
        height: H [m], for slender beams in tests.
        grading: see `GRADING`.
    """

    def __init__(
        self, dim: int, counts: tuple[int, ...], material: Material, height: float = HEIGHT, grading: float = GRADING
    ) -> None:
        ticks = [graded(LENGTH, counts[0], grading), graded_to_both_ends(height, counts[1], grading)]
        if dim == 3:
            ticks.insert(1, 0.5 * WIDTH - graded(0.5 * WIDTH, counts[2], grading)[::-1])
        self.elements, self.dim, self.material = Elements(ticks), dim, material
        X = self.elements.X
        free = np.repeat(X[:, :1] > 1e-12, dim, axis=1)
        if dim == 3:
            free[X[:, 1] < 1e-12, 1] = False
        self.held = Held(self.elements, free, material)
        end = np.array([LENGTH, 0.0, 0.5 * height] if dim == 3 else [LENGTH, 0.5 * height])
        self._centre = int(np.argmin(np.linalg.norm(X - end, axis=1)))
        self.end_weights = self.elements.face_weights(0, LENGTH)

    def tip(self, u: Array) -> Tip:
        """Return the displacement of the tip."""
        return Tip(self.end_weights @ u, u[self._centre])

    def frequency(self, about: Array | None = None) -> float:
        """Return the first frequency [Hz] of small bending vibrations in the plane of gravity, about rest or about u.

        In 3D the symmetry of the half leaves out bending along y, which has the same frequency.
        """
        return self.held.vibration(about)[0]

    def sag(self, gravity: float, first: float = 1.0) -> Array:
        """Return the displacement (n, D) [m] at rest under `gravity` [m/s^2] at finite strains; see `Held.rest`."""
        force = np.zeros(self.dim)
        force[-1] = -self.material.density * gravity
        return self.held.rest(self.elements.body_force(force), first)

    def end_load(self, force: Array) -> Array:
        """Return nodal forces (n, D) [N] of a force (D,) [N, in 2D N/m] spread evenly over the end face."""
        return self.end_weights[:, None] * force

"""Base of samplings: a sampling fills a shape with particles."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated

import numpy as np

from cqrun.geometry.shape import Shape
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin


class Sampling(Plugin):
    """Fills a shape with particles; the same settings give bit-for-bit identical particles."""

    @property
    def needs_spacing(self) -> bool:
        """Whether the body must give a spacing of particles."""
        return True

    @property
    def is_lattice(self) -> bool:
        """Whether neighbours are a spacing apart along the axes, so that a layer that misses is a gap."""
        return False

    def estimate(self, shape: Shape, spacing: float | None) -> float:
        """Return about how many points it tries, 0 if the shape cannot be filled; arguments as in `sample`."""
        lower, upper = shape.bounds()
        if spacing is None or not (np.isfinite(upper - lower).all() and (upper > lower).all()):
            return 0.0
        with np.errstate(over="ignore"):
            return float(np.prod((upper - lower) / spacing))

    @abstractmethod
    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        """Return positions (N, D) [m] and volumes (N,) [m^3; 2D: m^2].

        Args:
            shape: what to fill.
            spacing: distance between particles [m]; None for samplings that do not need it.

        Raises:
            UsageError: the shape cannot be filled.
        """


ChosenSampling = Annotated[Chosen[Sampling], Choice("sampling")]
"""Type of a field that holds any sampling."""

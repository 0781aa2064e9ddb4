"""Base of samplings: a sampling fills a shape with particles."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated

from cqrun.geometry.shape import Shape
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin


class Sampling(Plugin):
    """Fills a shape with particles; the same settings give bit-for-bit identical particles."""

    @property
    def needs_spacing(self) -> bool:
        """Whether the body must give a spacing of particles."""
        return True

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

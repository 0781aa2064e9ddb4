"""Base of regions: a region selects points, by their position at rest or by what they belong to.

Every shape is a region, and so is the name of one: `region: legs`. A region is resolved once, in material
coordinates: on the particles of one body after the other, or on the grid nodes for a boundary.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar, Protocol

from cqrun.boundaries.solid import Solid
from cqrun.errors import UnknownDistance
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin


class Points(Protocol):
    """Points at rest, with their names and colours."""

    @property
    def x(self) -> Array:
        """Positions (N, D) [m]."""

    @property
    def body(self) -> str | None:
        """Name of the body to which the particles belong; None for grid nodes."""

    def named(self, name: str) -> Array:
        """Return which points belong to a group of their body, or else to a region of the scene: (N,) bool."""

    def coloured(self, colour: str) -> Array:
        """Return which points lie in pixels of a colour, by its name or `#rrggbb`: (N,) bool."""


class Region(Plugin):
    """A region of a body."""

    of_particles: ClassVar[bool] = False
    """Whether it is defined for particles only, and not for grid nodes."""

    def solids(self) -> list[Solid]:
        """Return the solids with a signed distance whose union is the region: what bodies of the reference frame touch.

        Raises:
            UnknownDistance: no distance is known from shapes of this kind.
            UsageError: none is known from this one, or a file cannot be read.
        """
        raise UnknownDistance(f"the distance from the surface of '{self.name}' is not known")

    @abstractmethod
    def pick(self, points: Points) -> Array:
        """Return which points the region contains: (N,) bool.

        Raises:
            UsageError: it cannot be resolved on these points.
        """


ChosenRegion = Annotated[Chosen[Region], Choice("region")]
"""Type of a field that holds any region: a shape, the name of a region, or another choice of it."""

"""What regions are asked of: the particles of a body, or the nodes of the grid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cqrun.boundaries.condition import BoundaryCondition
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Array
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.geometry.named import Named
from cqrun.geometry.region import Region
from cqrun.geometry.shape import Shape, coloured_parts
from cqrun.scene.schema import Scene


@dataclass(frozen=True)
class BodyPoints:
    """A body's particles at rest.

    Attributes:
        body: its name.
        x: positions (N, D) in the coordinates of the region that is asked.
        world, local: positions (N, D) [m] in the world, and in the body's own coordinates (`place`).
        piece: (N,) which of the body's pieces each was sampled in.
    """

    scene: Scene
    body: str
    x: Array
    world: Array
    local: Array
    piece: Array
    _known: dict[str, Array] = field(default_factory=dict, repr=False, compare=False)

    def pick(self, region: Chosen[Region] | str | None) -> Array:
        """Return which particles a region of the scene, or a name, or None for everything, holds: (N,) bool.

        Raises:
            UsageError: it cannot be resolved on this body.
        """
        if region is None:
            return np.ones(len(self.world), bool)
        return self.named(region) if isinstance(region, str) else region.value.pick(self)

    def named(self, name: str) -> Array:
        """Return which particles a group, or else a region of the scene, holds; none where there is no such name."""
        if name not in self._known:
            self._known[name] = self._find(name)
        return self._known[name]

    def _find(self, name: str) -> Array:
        spec = self.scene.bodies[self.body]
        if name in (spec.parts or {}):
            return self.piece == list(spec.parts or {}).index(name)
        if name in spec.colours:
            return self.coloured(name)
        if name in spec.groups:
            return spec.groups[name].value.pick(replace(self, x=self.local))
        if name in self.scene.regions:
            return self.scene.regions[name].value.pick(replace(self, x=self.world))
        return np.zeros(len(self.world), bool)

    def coloured(self, colour: str) -> Array:
        """Return which particles lie in pixels of a colour of the image that their piece is made of."""
        pieces = list(self.scene.bodies[self.body].pieces.values())
        if not any(shape.has_colours for shape in pieces):
            raise UsageError(f"the body '{self.body}' is made of no image, so its particles have no colour")
        found = coloured_parts(pieces, self.local, colour)
        return np.any([(self.piece == k) & held for k, held in enumerate(found)], axis=0)

    @property
    def groups(self) -> dict[str, Array]:
        """Which particles each of the body's groups holds: (N,) bool by name."""
        return {name: self.named(name) for name in self.scene.bodies[self.body].group_names}


@dataclass(frozen=True)
class NodePoints:
    """Nodes of the grid at x (n, D) [m], for the region of a boundary."""

    scene: Scene
    x: Array
    body: None = None

    def named(self, name: str) -> Array:
        """Return which nodes a region of the scene holds."""
        return self.scene.regions[name].value.pick(self)

    def coloured(self, colour: str) -> Array:
        """Refuse: nodes have no colour."""
        raise UsageError("nodes of the grid have no colour")


@dataclass(frozen=True)
class _NodeRegion:
    """A region as a boundary asks for it."""

    scene: Scene
    region: Region

    def inside(self, nodes: Array) -> Array:
        return self.region.pick(NodePoints(self.scene, nodes))


def boundary(scene: Scene, name: str) -> BoundaryCondition:
    """Return a boundary whose region, if any, can be asked for nodes: a name in it means what the scene says.

    Raises:
        SceneError: it needs a normal, and what the name stands for has none.
    """
    spec: BoundaryCondition = scene.boundaries[name].value  # type: ignore[assignment]  # by its kind
    region: Chosen[Any] | None = spec.region
    if region is None or isinstance(region.value, Shape):
        return spec
    meant = _meant(scene, region)
    held: Any = meant.value if isinstance(meant.value, Shape) else _NodeRegion(scene, meant.value)
    spec = spec.model_copy(update={"region": Chosen(meant.name, held)})
    if spec.lacks_normal:
        path = f"boundaries.{name}.{spec.name}"
        raise SceneError([Problem(scene.where(path), path, spec.lack)])
    return spec


def _meant(scene: Scene, region: Chosen[Region]) -> Chosen[Region]:
    """Return what a name, if it is one of the scene's regions, stands for: terrain has normals under its name, too."""
    for _ in scene.regions:  # names of names end, or are refused elsewhere
        if isinstance(region.value, Named) and region.value.region in scene.regions:
            region = scene.regions[region.value.region]
    return region

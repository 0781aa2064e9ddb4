"""The points that a region selects from: the particles of a body, or the nodes of the grid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cqrun.boundaries.condition import BoundaryCondition
from cqrun.boundaries.solid import Solid
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.geometry.named import Named
from cqrun.geometry.region import Region
from cqrun.geometry.shape import Shape, coloured_parts
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene


@dataclass(frozen=True)
class BodyPoints:
    """The particles of a body at rest.

    Attributes:
        scene: the scene.
        body: name of the body.
        x: positions (N, D) in the coordinates of the region that is evaluated.
        world, local: positions (N, D) [m] in the world, and in the body's own coordinates (`place`).
        piece: number of the body's piece in which each particle was sampled (N,).
    """

    scene: Scene
    body: str
    x: Array
    world: Array
    local: Array
    piece: Array
    _cache: dict[str, Array] = field(default_factory=dict, repr=False, compare=False)

    def pick(self, region: Chosen[Region] | str | None) -> Array:
        """Return which particles are inside a region, or a named region, or True for all if None: (N,) bool.

        Raises:
            UsageError: the region cannot be evaluated on this body.
        """
        if region is None:
            return np.ones(len(self.world), bool)
        return self.named(region) if isinstance(region, str) else region.value.pick(self)

    def named(self, name: str) -> Array:
        """Return which particles a group, or else a region of the scene, holds; none if the name does not exist."""
        if name not in self._cache:
            self._cache[name] = self._find(name)
        return self._cache[name]

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
        """Return which particles lie in pixels of a colour, in the image of their piece."""
        pieces = list(self.scene.bodies[self.body].pieces.values())
        if not any(shape.has_colours for shape in pieces):
            raise UsageError(f"the body '{self.body}' is not made from an image, so its particles have no colour")
        parts = coloured_parts(pieces, self.local, colour)
        return np.any([(self.piece == k) & inside for k, inside in enumerate(parts)], axis=0)

    @property
    def groups(self) -> dict[str, Array]:
        """The particles in each group of the body: (N,) bool by name."""
        return {name: self.named(name) for name in self.scene.bodies[self.body].group_names}


@dataclass(frozen=True)
class NodePoints:
    """Nodes of the grid at x (n, D) [m], from which the region of a boundary selects."""

    scene: Scene
    x: Array
    body: None = None

    def named(self, name: str) -> Array:
        """Return which nodes are inside a region of the scene."""
        return self.scene.regions[name].value.pick(self)

    def coloured(self, colour: str) -> Array:
        """Raise a UsageError: nodes have no colour."""
        raise UsageError("nodes of the grid have no colour")


@dataclass(frozen=True)
class _NodeRegion:
    """A region with the interface that a boundary needs."""

    scene: Scene
    region: Region

    def inside(self, nodes: Array) -> Array:
        return self.region.pick(NodePoints(self.scene, nodes))

    def solids(self) -> list[Solid]:
        return self.region.solids()


def boundary(scene: Scene, name: str) -> BoundaryCondition:
    """Return a boundary whose region, if any, can select nodes: names in it are looked up in the scene.

    Raises:
        SceneError: the boundary needs a normal, and its region has none.
    """
    spec: BoundaryCondition = scene.boundaries[name].value  # type: ignore[assignment]  # by its kind
    region: Chosen[Any] | None = spec.region
    if region is not None and not isinstance(region.value, Shape):
        found = resolved(scene, region)
        inner: Any = found.value if isinstance(found.value, Shape) else _NodeRegion(scene, found.value)
        spec = spec.model_copy(update={"region": Chosen(found.name, inner)})
    touched = scene.world.frame == "reference" and spec.is_obstacle
    if spec.lacks_normal or (getattr(spec, "only_touched", False) and not touched):
        path = f"boundaries.{name}.{spec.name}"
        raise SceneError([Problem(scene.where(path), path, spec.lack)])
    return spec


def resolved(scene: Scene, region: Chosen[Region]) -> Chosen[Region]:
    """Return the region itself in place of its name, so that a named terrain has normals too."""
    for _ in scene.regions:  # circular names are refused elsewhere
        if isinstance(region.value, Named) and region.value.region in scene.regions:
            region = scene.regions[region.value.region]
    return region

"""Positions and volumes of particles at rest, as functions of the numbers in shapes and places.

Particles are sampled once, at the values in the scene, and then follow the shape. Each piece of a body moves its
particles by a piecewise smooth map (`Shape.carried`), and the body's place puts them into the world. Volumes, and with
them masses, grow by the determinant of the map's slope. The particles of a region or a marker remain the same.

The derivative by a number p is computed by a complex step, Im f(p + ih) / h with a tiny h, which has no cancellation
(W. Squire, G. Trapp: Using complex variables to estimate derivatives of real functions, SIAM Review 40 (1998)).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cqrun.build.particles import Particles
from cqrun.build.surfaces import BodySurface, surface_of, touches
from cqrun.geometry.place import Place
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Array, Spec
from cqrun.scene.body import Body
from cqrun.scene.paths import shapes_a_body
from cqrun.scene.schema import Scene

STEP = 1e-30


class Geometry:
    """The map from geometric values to rest positions and volumes, and its adjoint.

    Args:
        scene: the scene at whose values the particles were sampled.
        particles: the particles of the scene.
    """

    def __init__(self, scene: Scene, particles: Particles) -> None:
        self.scene, self.particles = scene, particles

    def changes(self, values: Mapping[str, Array]) -> bool:
        """Return whether positions at rest depend on one of these values."""
        return any(map(shapes_a_body, values))

    def at_rest(self, values: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return positions (N, D) [m] and volumes (N,) [m^D] at rest."""
        x, volume = self.particles.x.copy(), self.particles.volume.copy()
        for body, numbers in self._by_body(values).items():
            part = self.particles.of(body)
            points = self.particles.points[body]
            x[part], growth = self._carried(body, numbers, points.local, points.piece)
            volume[part] *= growth
        return x, volume

    def at_rest_vjp(self, values: Mapping[str, Array], x_bar: Array, volume_bar: Array, out: dict[str, Array]) -> None:
        """Add the cotangents of the geometric values to the gradients in `out`.

        Args:
            values: values by key path.
            x_bar, volume_bar: cotangents (N, D), (N,) of positions and volumes.
            out: gradients by key path.
        """
        for body, numbers in self._by_body(values).items():
            part = self.particles.of(body)
            volume_bar_b = volume_bar[part] * self.particles.volume[part]
            for path, value in numbers.items():
                points = self.particles.points[body]
                moved, growth = self._carried(body, {**numbers, path: value + STEP * 1j}, points.local, points.piece)
                slope = np.einsum("nd,nd->", x_bar[part], np.imag(moved)) + volume_bar_b @ np.imag(growth)
                out[path] += slope / STEP

    def surface_at_rest(self, values: Mapping[str, Array]) -> Array:
        """Return the positions of the surfaces' points at rest (S, D) [m]; empty if nothing moves or touches them."""
        moved = self._by_body(values)
        if not moved or not touches(self.scene):
            return np.zeros((0, self.scene.dim))
        surface = surface_of(self.scene, self.particles)
        x = surface.x.copy()
        for body, numbers in moved.items():
            own, local, piece = self._of_surface(surface, body)
            x[own] = self._carried(body, numbers, local, piece)[0]
        return x

    def surface_at_rest_vjp(self, values: Mapping[str, Array], x_bar: Array, out: dict[str, Array]) -> None:
        """Add the cotangents of the geometric values to the gradients in `out`, from that of the points (S, D)."""
        for body, numbers in self._by_body(values).items() if len(x_bar) else ():
            own, local, piece = self._of_surface(surface_of(self.scene, self.particles), body)
            for path, value in numbers.items():
                moved, _ = self._carried(body, {**numbers, path: value + STEP * 1j}, local, piece)
                out[path] += np.einsum("nd,nd->", x_bar[own], np.imag(moved)) / STEP

    def _of_surface(self, surface: BodySurface, body: str) -> tuple[slice, Array, Array]:
        """Return a body's points: their slice, their local coordinates, and the pieces of their nearest particles."""
        k = self.particles.names.index(body)
        own = slice(int(surface.begin[k]), int(surface.begin[k + 1]))
        piece = self.particles.points[body].piece[surface.particle[own] - self.particles.of(body).start]
        return own, surface.local[own], piece

    def _by_body(self, values: Mapping[str, Array]) -> dict[str, dict[str, Any]]:
        """Return the geometric values of each body that has any."""
        by_body: dict[str, dict[str, Any]] = {}
        for path, value in values.items():
            if shapes_a_body(path):
                by_body.setdefault(path.split(".")[1], {})[path] = float(np.asarray(value).reshape(-1)[0])
        return by_body

    def _carried(self, body: str, numbers: Mapping[str, Any], local: Array, piece: Array) -> tuple[Array, Array]:
        """Return positions (n, D) and volume ratios (n,) of a body's points; complex if a number is complex.

        Args:
            local: their positions (n, D) in the body's own coordinates.
            piece: the body's piece with which each moves (n,).
        """
        before = self.scene.bodies[body]
        after: Body = before
        for path, value in numbers.items():
            after = replaced(after, path.split(".")[2:], value)
        order, carried = [], []
        for k, (shape, shape_to) in enumerate(zip(before.pieces.values(), after.pieces.values(), strict=True)):
            indices = np.flatnonzero(piece == k)
            order.append(indices)
            carried.append(shape.carried(local[indices], shape_to))
        back = np.argsort(np.concatenate(order))
        moved, growth = (np.concatenate(each)[back] for each in zip(*carried, strict=True))
        if before.place is None:
            return moved, growth
        place, place_to = before.place, after.place or Place()
        return place_to.to_world(moved), growth * (place_to.scale / place.scale) ** self.scene.dim


def replaced(node: Any, keys: Sequence[str], value: Any) -> Any:
    """Return a part of a scene with one value replaced, without validation, because the value may be complex."""
    if not keys:
        return value
    key, rest = keys[0], keys[1:]
    if isinstance(node, Chosen):
        return Chosen(node.name, replaced(node.value, rest, value))
    if isinstance(node, Spec):
        return node.model_copy(update={key: replaced(getattr(node, key), rest, value)})
    if isinstance(node, Mapping):
        return {**node, key: replaced(node[key], rest, value)}
    k = int(key)
    return [*node[:k], replaced(node[k], rest, value), *node[k + 1 :]]

"""The numbers of rigid bodies that a rollout gets (`Inputs.rigid`, `Inputs.waypoints`) from values by key path."""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.build.particles import Particles
from cqrun.build.rigid import parts_of
from cqrun.build.values import Values, collect, numbers, updated
from cqrun.engine.rigid_model import FORCE, FRICTION, INERTIA, MASS, NUMBERS, OFFSET, SPIN, TORQUE, VELOCITY
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

VECTORS = {"offset": OFFSET, "velocity": VELOCITY, "force": FORCE}
TURNS = {"spin": SPIN, "torque": TORQUE}
"""Fields and their columns: vectors of the world, and vectors along axes of rotation, of which 2D has one."""


class RigidValues:
    """The map from values to the numbers of rigid bodies, and its adjoint."""

    def __init__(self, scene: Scene, particles: Particles) -> None:
        self.scene, self.dim = scene, scene.dim
        self.parts = parts_of(scene, particles) if scene.rigid and scene.world.frame == "reference" else {}
        self.bodies = {name: scene.rigid[name] for name in self.parts}

    def masses(self, values: Values) -> dict[str, float]:
        """Return the masses of free bodies by name [kg]; of the others 0."""
        return {name: self._mass(name, self._body(name, values)) for name in self.bodies}

    def inputs(self, values: Values) -> tuple[Array, Array]:
        """Return `Inputs.rigid` (B, 20) and `Inputs.waypoints` (W, 6)."""
        rows = np.zeros((len(self.bodies), NUMBERS))
        for row, name in zip(rows, self.bodies, strict=True):
            body, part = self._body(name, values), self.parts[name]
            row[MASS], row[FRICTION] = self._mass(name, body), body.friction
            row[INERTIA] = part.moments * (1.0 if body.inertia is not None else row[MASS])
            for fields in (VECTORS, TURNS):
                for field, at in fields.items():
                    row[self._columns(at, fields is TURNS)] = getattr(body, field)
            row[self._columns(FORCE, False)] += row[MASS] * self._gravity(values)
        return rows, self._waypoints(values)

    def inputs_vjp(self, values: Values, bar: Array, waypoints_bar: Array, out: dict[str, Array]) -> None:
        """Add to the gradients in `out`."""
        gravity, gravity_bar = self._gravity(values), np.zeros(self.dim)
        for row_bar, name in zip(bar, self.bodies, strict=True):
            body, part = self._body(name, values), self.parts[name]
            force_bar = row_bar[self._columns(FORCE, False)]
            mass_bar = row_bar[MASS] + gravity @ force_bar
            if body.inertia is None:
                mass_bar += part.moments @ row_bar[INERTIA]
            if body.free:
                gravity_bar += self._mass(name, body) * force_bar
            cotangents: dict[str, Any] = {"friction": row_bar[FRICTION], "mass": mass_bar}
            if body.density is not None and part.properties is not None:
                cotangents["density"] = mass_bar * part.properties.volume
            for fields in (VECTORS, TURNS):
                for field, at in fields.items():
                    cotangents[field] = row_bar[self._columns(at, fields is TURNS)]
            collect(f"rigid.{name}", cotangents, out)
        collect("world", {"gravity": gravity_bar}, out)
        row = 0
        for name, body in self.bodies.items():
            for k in range(len(body.waypoints)):
                turns = waypoints_bar[row][self._columns(slice(3, 6), True)]
                each = {"displacement": waypoints_bar[row, : self.dim], "rotation": turns}
                collect(f"rigid.{name}.path.{k}", each, out)
                row += 1

    def _body(self, name: str, values: Values) -> Any:
        return updated(self.bodies[name], f"rigid.{name}", values)

    def _mass(self, name: str, body: Any) -> float:
        found = self.parts[name].properties
        if not body.free or found is None:
            return 0.0
        return float(body.mass if body.mass is not None else body.density * found.volume)

    def _gravity(self, values: Values) -> Array:
        return numbers("world.gravity", list(self.scene.world.gravity), values)

    def _columns(self, at: slice, turns: bool) -> slice:
        """Return the columns of a vector, or of one along axes of rotation, that a world has."""
        if self.dim == 3:
            return at
        return slice(at.start + 2, at.stop) if turns else slice(at.start, at.start + 2)

    def _waypoints(self, values: Values) -> Array:
        rows = []
        for name, body in self.bodies.items():
            for k, point in enumerate(body.waypoints):
                point, row = updated(point, f"rigid.{name}.path.{k}", values), np.zeros(6)
                row[: self.dim] = point.displacement
                row[self._columns(slice(3, 6), True)] = point.rotation
                rows.append(row)
        return np.array(rows).reshape(-1, 6)

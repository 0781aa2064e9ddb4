"""Scenes of the convergence tables, and their states: plain data for `load_scene`, so a frame is one more key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from benchmarks.convergence.laws import LAWS, lame
from benchmarks.convergence.points import Point
from cqrun.build.model import Built, build
from cqrun.engine.frames import make_rollout
from cqrun.engine.rollout import Rollout
from cqrun.plugin.contract import Array
from cqrun.scene.load import load_scene
from cqrun.scene.world_and_time import World
from cqrun.state import State

YOUNGS_MODULUS, DENSITY = 3.0e5, 1070.0
PER_AXIS = 2
"""Particles in a cell along each axis."""


@dataclass(frozen=True)
class Block:
    """A box of particles: its lower corner and size (D,) [m]. The last axis points up."""

    corner: tuple[float, ...]
    size: tuple[float, ...]


def frames_of_this_version() -> tuple[str, ...]:
    """Return the values that `world.frame` can have; `updated` is the only frame of a version without this key."""
    field = World.model_fields.get("frame")
    return ("updated",) if field is None else get_args(field.annotation)


def scene(point: Point, block: Block, world: Mapping[str, Any], **sections: Any) -> dict[str, Any]:
    """Return a scene of one body `block`, without its time.

    Args:
        world: section `world`, without the frame.
        sections: further sections; `body` holds further keys of the body.
    """
    frame = {"frame": point.frame} if "frame" in World.model_fields else {}
    elastic = {point.law: {"youngs_modulus": YOUNGS_MODULUS, "poissons_ratio": point.poissons_ratio}}
    body = {
        "shape": {"box": {"corner": list(block.corner), "size": list(block.size)}},
        "particles_per_cell": float(PER_AXIS**point.dim),
        "material": {"density": DENSITY, "elastic": elastic},
        **sections.pop("body", {}),
    }
    return {"cqrun": 1, "world": {**world, **frame}, "bodies": {"block": body}, **sections}


def with_time(data: Mapping[str, Any], point: Point, control_step: float, count: int) -> Built:
    """Build a scene with `count` control steps; the substeps are those that `auto` chooses, times the point's factor.

    Raises:
        SceneError: the scene, or its frame, cannot do this.
    """
    time = {"duration": count * control_step, "control_step": control_step}
    built = build(load_scene({**data, "time": time}))
    if point.substeps == 1:
        return built
    substeps = point.substeps * int(built.scene.time.substeps)
    return build(load_scene({**data, "time": {**time, "substeps": substeps}}))


def observe(built: Built, see: Callable[[State], Any]) -> Array:
    """Run a scene; return what `see` finds in the state at the start and after every control step (T + 1, ...).

    Raises:
        RolloutError: the scene blows up.
    """
    found: list[Any] = []
    rollout = _rollout(built)
    rollout.run(lambda step, state: found.append(see(state)))
    return np.array(found)


def _rollout(built: Built) -> Rollout:
    """Return a rollout in the scene's frame."""
    return make_rollout(built.model, built.assembly.inputs({}))


@dataclass(frozen=True)
class Matter:
    """The particles of a built scene at rest: mass (N,) [kg], volume (N,) [m^D], positions X (N, D) [m]."""

    point: Point
    mass: Array
    volume: Array
    X: Array
    dx: float

    @classmethod
    def of(cls, built: Built, point: Point) -> Matter:
        """Return the particles of a scene."""
        inputs = built.assembly.inputs({})
        return cls(point, inputs.fields.mass, inputs.fields.volume, inputs.state.x.copy(), built.scene.world.dx)

    @property
    def spacing(self) -> float:
        """Distance between the particles [m]."""
        return float(self.volume.mean() ** (1.0 / self.point.dim))

    def centre(self, values: Array) -> Array:
        """Return the mean of values (N, ...) over the mass."""
        return np.asarray(self.mass @ values / self.mass.sum())

    def kinetic_energy(self, state: State) -> float:
        """Return the kinetic energy [J], with that of the affine velocities inside the cells: (dx^2 / 8) m |C|^2."""
        inner = self.dx**2 / 4.0 * (state.C**2).sum((1, 2))
        return float(0.5 * self.mass @ ((state.v**2).sum(1) + inner))

    def elastic_energy(self, state: State) -> float:
        """Return the elastic energy of F [J]."""
        mu, lam = lame(YOUNGS_MODULUS, self.point.poissons_ratio)
        law = LAWS[self.point.law]
        g = law.volume(np.linalg.det(state.F))[0]
        return float(self.volume @ (mu * law.shear_energy(state.F) + 0.5 * lam * g**2))

    def angular_momentum(self, state: State) -> float:
        """Return the angular momentum [kg m^2/s] in the plane of the first and the last axis, with that of C."""
        arm = state.x - self.centre(state.x)
        moment = np.einsum("p,pi,pj->ij", self.mass, arm, state.v)
        moment += self.dx**2 / 4.0 * np.einsum("p,pij->ji", self.mass, state.C)
        return float(moment[0, -1] - moment[-1, 0])

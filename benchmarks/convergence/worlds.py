"""Scenes of the convergence tables, and their states: plain data for `load_scene`, so a frame is one more key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from benchmarks.convergence.laws import LAWS, lame
from benchmarks.convergence.points import UPDATED, Point
from cqrun.build.model import Built, build
from cqrun.engine.frames import make_rollout
from cqrun.engine.reference.rollout import ReferenceRollout
from cqrun.engine.rollout import Rollout
from cqrun.plugin.contract import Array
from cqrun.scene.load import load_scene
from cqrun.scene.world_and_time import World
from cqrun.state import State

YOUNGS_MODULUS, DENSITY = 3.0e5, 1070.0
PER_AXIS = 2
"""Particles in a cell along each axis."""

FRAMES: dict[str, dict[str, Any]] = {
    UPDATED: {"frame": "updated"},
    "reference": {"frame": "reference", "volume": "local"},
    "averaged": {"frame": "reference", "volume": "averaged"},
}
"""What is compared: name in the tables -> keys of section `world`. One more line is one more column of the tables."""


@dataclass(frozen=True)
class Block:
    """A box of particles: its lower corner and size (D,) [m]. The last axis points up."""

    corner: tuple[float, ...]
    size: tuple[float, ...]


def frames_of_this_version() -> tuple[str, ...]:
    """Return the names in `FRAMES` whose keys a scene of this version can have."""
    return tuple(name for name, keys in FRAMES.items() if all(_has(key, value) for key, value in keys.items()))


def _has(key: str, value: str) -> bool:
    """Return whether section `world` has a key with a value."""
    field = World.model_fields.get(key)
    return field is not None and value in get_args(field.annotation)


def scene(point: Point, block: Block, world: Mapping[str, Any], **sections: Any) -> dict[str, Any]:
    """Return a scene of one body `block` that is a box, without its time; see `scene_of`."""
    return scene_of(point, {"box": {"corner": list(block.corner), "size": list(block.size)}}, world, **sections)


def scene_of(point: Point, shape: Mapping[str, Any], world: Mapping[str, Any], **sections: Any) -> dict[str, Any]:
    """Return a scene of one body `block` of any shape, without its time.

    Args:
        world: section `world`, without the keys of the frame.
        sections: further sections; `body` holds further keys of the body.
    """
    elastic = {point.law: {"youngs_modulus": YOUNGS_MODULUS, "poissons_ratio": point.poissons_ratio}}
    body = {
        "shape": shape,
        "particles_per_cell": float(PER_AXIS**point.dim),
        "material": {"density": DENSITY, "elastic": elastic},
        **sections.pop("body", {}),
    }
    return {"cqrun": 1, "world": {**world, **FRAMES[point.frame]}, "bodies": {"block": body}, **sections}


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


@dataclass(frozen=True)
class Nodes:
    """The nodes of the reference frame, and the points of the surface that they move.

    Attributes:
        mass, x, v: of the nodes: mass (M,) [kg], places (M, D) [m], velocities (M, D) [m/s].
        surface: places of the points (S, D) [m]; none in a scene without contact.
    """

    mass: Array
    x: Array
    v: Array
    surface: Array


def observe(built: Built, see: Callable[[State], Any]) -> Array:
    """Run a scene; return what `see` finds in the state at the start and after every control step (T + 1, ...).

    Raises:
        RolloutError: the scene blows up.
    """
    return observe_nodes(built, lambda state, nodes: see(state))


def observe_nodes(built: Built, see: Callable[[State, Nodes | None], Any]) -> Array:
    """Do the same with the nodes, which are None in the updated frame: there particles carry the momentum."""
    rollout, found = make_rollout(built.model, built.assembly.inputs({})), []
    states, substeps = rollout.start[None].copy(), rollout.model.substeps
    for control in range(rollout.model.n_controls + 1):
        found.append(see(rollout.unpack(states[0], control), nodes_of(rollout, states[0])))
        if control < rollout.model.n_controls:
            rollout.advance(control * substeps, (control + 1) * substeps, states, keep=False)
    return np.array(found)


def nodes_of(rollout: Rollout, q: Array) -> Nodes | None:
    """Return the nodes of a packed state, or None in the updated frame."""
    if not isinstance(rollout, ReferenceRollout):
        return None
    mass, dim = rollout.bundle.nodes.mass, rollout.model.dim
    u, v = q[:, : len(mass), :dim]
    surface = np.zeros((0, dim))
    if rollout.contacts.obstacles and rollout.model.surface is not None:
        points = rollout.contacts.obstacles[0].surface.points
        surface = rollout.model.surface.x + np.einsum("sk,skd->sd", points.weight, u[points.node])
    return Nodes(mass, rollout.rest.patches.positions(rollout.model.dx) + u, v.copy(), surface)


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

    def kinetic_energy(self, state: State, nodes: Nodes | None) -> float:
        """Return the kinetic energy [J] of the nodes, or of the particles with that of C, (dx^2 / 8) m |C|^2."""
        if nodes is not None:
            return float(0.5 * nodes.mass @ (nodes.v**2).sum(1))
        inner = self.dx**2 / 4.0 * (state.C**2).sum((1, 2))
        return float(0.5 * self.mass @ ((state.v**2).sum(1) + inner))

    def elastic_energy(self, state: State) -> float:
        """Return the elastic energy of F [J]."""
        mu, lam = lame(YOUNGS_MODULUS, self.point.poissons_ratio)
        law = LAWS[self.point.law]
        g = law.volume(np.linalg.det(state.F))[0]
        return float(self.volume @ (mu * law.shear_energy(state.F) + 0.5 * lam * g**2))

    def angular_momentum(self, state: State, nodes: Nodes | None) -> float:
        """Return the angular momentum [kg m^2/s] in the plane of the first and the last axis.

        It is that of the nodes, or of the particles with that of C.
        """
        if nodes is not None:
            arm = nodes.x - nodes.mass @ nodes.x / nodes.mass.sum()
            moment = np.einsum("n,ni,nj->ij", nodes.mass, arm, nodes.v)
        else:
            arm = state.x - self.centre(state.x)
            moment = np.einsum("p,pi,pj->ij", self.mass, arm, state.v)
            moment += self.dx**2 / 4.0 * np.einsum("p,pij->ji", self.mass, state.C)
        return float(moment[0, -1] - moment[-1, 0])

"""A small scene for plug-ins that use particles: two bodies, groups, a goal; and derivatives by complex step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from cqrun.actuators.body_force import BodyForce
from cqrun.actuators.cable import Cable
from cqrun.actuators.chamber import Chamber
from cqrun.actuators.muscle import Muscle
from cqrun.actuators.pneumatic import Pneumatic
from cqrun.engine.model import Model
from cqrun.engine.reference.corners import hat_slopes, hats
from cqrun.engine.reference.rest import rest_geometry
from cqrun.forces.spring import Spring
from cqrun.materials.fixed_corotated import FixedCorotated
from cqrun.materials.incompressibility import Incompressibility
from cqrun.materials.neo_hookean import NeoHookean
from cqrun.materials.viscosity import Viscosity
from cqrun.observers.matter import ActuatorPart, Corners, Material, Matter, Route, Wall
from cqrun.plugin.registry import plugins
from cqrun.state import Layout

STEP = 1e-30
"""Size of the imaginary part; it gives an exact derivative."""

SCALE, CELL = 20.0, 3.0
"""Of a body on a grid: so large that differences by positions at rest are exact to rounding."""

CONTROL_STEP, N_CONTROLS, N_ACTUATORS = 0.05, 6, 3


def made_matter(dim: int) -> Matter:
    """Return a lattice `arm` with the groups `left` and `tip`, and a `ball` without groups."""
    lattice = np.stack(np.meshgrid(*[np.arange(n) for n in (4, 3, 2)[:dim]], indexing="ij"), -1).reshape(-1, dim)
    arm, ball = 0.1 * lattice + 0.2, 0.05 * lattice[: 2 * dim] + 0.8
    x = np.concatenate([arm, ball])
    bodies = {"arm": slice(0, len(arm)), "ball": slice(len(arm), len(x))}
    groups = {"left": np.flatnonzero(arm[:, 0] < 0.35), "tip": np.flatnonzero(arm[:, 0] > 0.45)}

    def select(body: str | None, region: Any) -> np.ndarray:
        part = bodies[body] if body is not None else slice(0, len(x))
        index = np.arange(len(x))[part]
        return index if region is None else index[region.value.inside(x[index])]

    size = np.array([2.0, 1.0, 1.5][:dim])
    seen = np.linspace(0.0, 0.4, 9)[:, None] * [1.0, 0.5, 0.25][:dim] + 0.1
    return Matter(
        x, np.ones(len(x)), size, CONTROL_STEP, N_CONTROLS, bodies, {"arm": groups, "ball": {}}, select,
        {"target": dim, "pace": 1}, N_ACTUATORS, design=1.5 + np.linspace(0.0, 1.0, 4 * len(x)).reshape(4, -1),
        recorded=lambda file, units, marker: (np.linspace(0.0, 0.4, 9), seen), neutral=np.array([0.0, 1.0, 0.5]),
        measures=made_measures(dim), spacing={"arm": 0.1, "ball": 0.05}, routes=made_routes(dim),
        n_parts=N_ACTUATORS + 1, parts=made_parts(dim), materials=made_materials(len(arm)),
        room=np.linspace(0.5, 1.0, len(x)), walls=made_walls(dim),
    )  # fmt: skip


def averaged_matter(dim: int) -> Matter:
    """Return `made_matter` with volumes averaged over the corners of cells, and `SCALE` times as large."""
    matter = made_matter(dim)
    counts = tuple(part.stop - part.start for part in matter.bodies.values())
    model = Model(SCALE * matter.size, CELL, 1.0, 1, 1, tuple(matter.bodies), Layout(dim, counts), ())
    geometry = lambda x: rest_geometry(model, x)  # noqa: E731
    corners = Corners(lambda x: hats(geometry(x)), lambda x: hat_slopes(geometry(x)))
    return replace(matter, x=SCALE * matter.x, size=model.size, corners=corners)


def made_materials(n_arm: int) -> dict[str, Material]:
    """Return the materials of both bodies: each law, and each further term, in one of them."""
    soft = NeoHookean(youngs_modulus=2.0, poissons_ratio=0.3), Viscosity(shear=0.4, bulk=0.2)
    firm = FixedCorotated(youngs_modulus=2.0, poissons_ratio=0.3), Incompressibility(power=4)
    return {
        "arm": Material(0, 0, [term.kernel_term for term in soft]),
        "ball": Material(1, n_arm, [term.kernel_term for term in firm]),
    }


N_WEIGHTS = 12
"""Number of weights of the particles of the parts in `made_parts`."""


def made_parts(dim: int) -> list[ActuatorPart]:
    """Return parts of actuators of every kind with a potential, and cables; each of four particles."""
    axis = [1.0, 2.0, -1.0][:dim]
    laws = {
        "muscle": Muscle(body="arm", axis=axis, strength=1.0), "chamber": Pneumatic(body="arm", max_pressure=1.0),
        "old_chamber": Pneumatic(body="arm", max_pressure=1.0, law="chainqueen"),
        "magnet": BodyForce(body="ball", direction=axis, acceleration=1.0),
    }  # fmt: skip
    on = np.array([0, 2, 4, 5])
    x = np.zeros((4, dim))
    parts = [
        ActuatorPart(name, name, k % N_ACTUATORS, law, on, law.constants(x), slice(4 * (k % 3), 4 * (k % 3) + 4))
        for k, (name, law) in enumerate(laws.items())
    ]
    more = {name: made_routes(dim)[name] for name in ("cable", "weight", "tendon", "rubbed")}
    routed = [ActuatorPart(n, n, r.number, r.law, r.particles, np.zeros(0), slice(0, 0)) for n, r in more.items()]
    routed += [
        ActuatorPart(n, n, w.number, w.law, w.particles, np.zeros(0), slice(0, 0)) for n, w in made_walls(dim).items()
    ]
    return [*parts, *routed, replace(parts[0], actuator="both"), replace(parts[1], actuator="both")]


def made_routes(dim: int) -> dict[str, Route]:
    """Return a cable whose length is set, one whose force is set, and a spring, along particles of the arm.

    Then tendons with friction, of both laws, which run beside the particles and end at a point of the world.
    """
    line = [[0.2] * dim, [0.5] * dim]
    cable, weight = Cable(body="arm", route=line, stiffness=2.0), Cable(body="arm", route=line, tension=2.0)
    spring = Spring(body="arm", route=line, stiffness=2.0)
    along = np.array([0, 3, 5, 1])
    tendon = Cable(body="arm", route=line, stiffness=2.0, friction=0.3)
    rubbed = Cable(body="arm", route=line, tension=2.0, friction=0.3)
    beside = np.full((5, dim), 0.7)  # large steps to either side, far from the kink of a straight route
    beside[:4] = 0.1
    beside[:4, 0] = 0.6, -0.6, 0.6, -0.6
    to_world = np.append(along, -1)
    return {
        "cable": Route(along, 1, cable, activated=True), "weight": Route(along[:2], 2, weight, activated=True),
        "spring": Route(along[1:], N_ACTUATORS, spring, activated=False),
        "tendon": Route(to_world, 1, tendon, activated=True, offsets=beside, begin=0.1, turn=0.8),
        "rubbed": Route(to_world, 2, rubbed, activated=True, offsets=beside),
    }  # fmt: skip


def made_walls(dim: int) -> dict[str, Wall]:
    """Return chambers in a simplex of points that ride on particles of the arm: of each supply."""
    supplies = {"air": {"pressure": 2.0}, "gas": {"gas": 2.0, "ambient": 3.0}, "oil": {"liquid": 2.0}}
    laws = {name: Chamber(body="arm", **given, bulk_modulus=2.0) for name, given in supplies.items()}
    corners = np.arange(dim + 1)
    facets = np.array([np.delete(corners, k)[:: 1 if k % 2 == 0 else -1] for k in corners])
    if dim == 3:
        facets = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
    offsets = 0.1 * np.cos(np.arange((dim + 1) * dim)).reshape(dim + 1, dim)
    return {name: Wall(corners + 1, offsets, facets, k, law) for k, (name, law) in enumerate(laws.items())}


def made_measures(dim: int) -> dict[str, Any]:
    """Return measured quantities whose values are exact for complex numbers."""
    return {
        "tip": plugins("measure")["displacement"](body="arm", group="tip"),
        "gap": plugins("measure")["distance"](body="arm", to="ball"),
        "cable": plugins("measure")["cable_tension"](cable="weight"),
        "held": plugins("measure")["reaction"](boundary="clamp"),
        "energy": plugins("measure")["kinetic_energy"](body="ball"),
        "slips": plugins("measure")["rigid_motion"](rigid="stone", relative_to="jaw"),
        "spins": plugins("measure")["rigid_motion"](rigid="stone", of="spin"),
        "twists": plugins("measure")["reaction"](boundary="floor", of="moment", on="boundary"),
        "pulls": plugins("measure")["cable_tension"](cable="cable"),
        "rubs": plugins("measure")["cable_tension"](cable="tendon", at=1.0),
        "blows": plugins("measure")["chamber_pressure"](chamber="gas"),
    }


def box_around_left(dim: int) -> dict[str, Any]:
    """Return a region as in a scene: the left half of the arm."""
    return {"box": {"corner": [0.15] * dim, "size": [0.2, *[1.0] * (dim - 1)]}}


def moved(value: Any, direction: Any) -> Any:
    """Return an array, or a mapping of arrays, with an imaginary part along a direction."""
    if isinstance(value, dict):
        return {name: moved(value[name], direction[name]) for name in value}
    if isinstance(value, list):
        return [moved(each, along) for each, along in zip(value, direction, strict=True)]
    return value + 1j * STEP * direction


def slope(function: Callable[[], Any], bar: Any) -> float:
    """Return the dot product of bar and the derivative of a function with moved arguments."""
    return float(np.sum(np.asarray(bar) * np.imag(function()))) / STEP


def mismatch(actual: float, expected: float, scale: float) -> float:
    """Return the error of a dot product, relative to its value, or to the size of its parts if they cancel."""
    return abs(actual - expected) / max(abs(expected), 1e-3 * scale, 1e-300)

"""Checks of sizes and quantities that point to another unit than was meant.

Scenes may use any consistent units. So a question is asked only where a ratio without units is absurd, or where the
scene's gravity or stiffness shows that it uses SI units.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cqrun.build.limits import Limit
from cqrun.errors import Problem, SceneError
from cqrun.geometry.mesh import UNITS, Mesh
from cqrun.geometry.place import Place
from cqrun.geometry.shape import Shape
from cqrun.materials.moduli import moduli_of
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

MOST_SUBSTEPS_IN_A_RUN = 100_000_000
"""A run of more is refused: 1,000 particles would take an hour, and a gradient several."""

LIGHT, HEAVY = 10.0, 30_000.0
"""Densities [kg/m^3] that no soft robot is made of: foams have 15 and more, osmium has 22,600."""

LARGE_WORLD = 20.0
"""Edge of a world [m] that may be meant in another unit."""

STANDARD_GRAVITY = (9.5, 10.1)
"""Range of the gravity near the ground [m/s^2], as it is rounded in scenes."""

SOFTEST = 1e3
"""A Young's modulus above this is probably in Pa: the softest gels have some 100 Pa; scenes without units use less."""

_LARGEST, _SMALLEST = 2.0, 0.1
"""Largest size of a body, in sizes of the world, and smallest, in cells. The bounds of turned shapes are loose."""

_LENGTHS = {"mm": "millimetres", "cm": "centimetres", "in": "inches", "m": "metres"}
"""Units of lengths in words, the likeliest first."""


def bodies_of_another_size(scene: Scene) -> Iterator[Problem]:
    """Yield a problem for each piece of a body that is far larger than the world, or far smaller than a cell.

    The bounds of a mesh are exact. So it is also asked about if it reaches out of the world at all, and another unit
    brings it inside. Of rigid bodies, only meshes are asked about: a plate may be larger than the world.
    """
    world, dx = np.array(scene.world.size), scene.world.dx
    for key, shape, place in _pieces(scene):
        size = _size(shape) * (place or Place()).scale
        if not (np.isfinite(size) & (size > 0)).all():
            continue
        if _SMALLEST * dx <= size.max() <= _LARGEST * world.max():
            if isinstance(shape, Mesh) and place is None and (question := _outside(scene, shape)):
                yield Problem(scene.where(key), key, question)
            continue
        large = size.max() > dx
        than = f"the world is {_product(world)} m" if large else f"a cell of the grid is {dx:.4g} m"
        message = f"is {_product(size)} m, but {than}{_other_unit(scene, shape, size, large)}"
        yield Problem(scene.where(key), key, message)


def _pieces(scene: Scene) -> Iterator[tuple[str, Shape, Place | None]]:
    """Yield the key path, the shape and the place of each piece of a soft body, and of each rigid mesh."""
    for name, body in scene.bodies.items():
        for path, shape in body.pieces.items():
            yield f"bodies.{name}.{path}", shape, body.place
    for name, rigid in scene.rigid.items():
        if isinstance(rigid.shape.value, Mesh):
            yield f"rigid.{name}.shape", rigid.shape.value, None


def _other_unit(scene: Scene, shape: Shape, size: Array, large: bool) -> str:
    """Return a question on the unit of a shape's lengths, and what to give then."""

    def fits(factor: float) -> bool:
        return bool((size * factor <= scene.world.size).all() and (size * factor).max() >= scene.world.dx)

    if isinstance(shape, Mesh):
        for unit, factor in _other_units(shape):
            if fits(factor):
                return f"; is its file in {_LENGTHS[unit]}? then give `units: {unit}`"
    for unit, words in _LENGTHS.items():
        factor = UNITS[unit] if large else 1.0 / UNITS[unit]
        if unit != "m" and fits(factor):
            question = f"are its lengths in {words}" if large else f"is the world in {words}"
            cure = (
                f"give `scale: {factor * shape.scale:.4g}`" if isinstance(shape, Place) else f"multiply by {factor:.4g}"
            )
            return f"; {question}? then {cure}"
    return ": check its unit"


def _outside(scene: Scene, mesh: Mesh) -> str:
    """Return a question on the unit of a mesh that is not in the world; empty if no other unit brings it there."""
    lower, upper = mesh.bounds()
    offset, world = np.array(mesh.offset or [0.0] * 3), np.array(scene.world.size)

    def within(factor: float) -> bool:
        low, high = (offset + factor * (corner - offset) for corner in (lower, upper))
        return bool((low >= 0).all() and (high <= world).all() and (high - low).max() >= scene.world.dx)

    if (lower < world).all() and (upper > 0).all() and (upper - lower <= world).all():
        return ""  # a part of it is in the world, which it fits
    for unit, factor in _other_units(mesh):
        if within(factor):
            return (
                f"reaches from {_point(lower)} to {_point(upper)} m, but the world is {_product(world)} m; is its file "
                f"in {_LENGTHS[unit]}? then give `units: {unit}`"
            )
    return ""


def _other_units(mesh: Mesh) -> Iterator[tuple[str, float]]:
    """Yield the other units that a mesh may have, and the factor of its size with each."""
    yield from ((unit, UNITS[unit] / UNITS[mesh.units]) for unit in _LENGTHS if unit != mesh.units)


def unit_questions(scene: Scene) -> Iterator[Problem]:
    """Yield warnings on quantities that are probably given in another unit."""
    if in_si(scene) and max(scene.world.size) > LARGE_WORLD:
        message = f"the world is {_product(scene.world.size)} m; are its lengths in millimetres? give them in metres"
        yield Problem(scene.where("world.size"), "world.size", message)
    for name, body in scene.bodies.items():
        if body.unit_mass:
            continue
        densities = {f"bodies.{name}.material.density": body.material.density}
        for region, other in body.material_of.items():
            if other.density is not None:
                densities[f"bodies.{name}.material_of.{region}.density"] = other.density
        for path, density in densities.items():
            if in_si(scene) and not LIGHT <= density <= HEAVY:
                yield Problem(scene.where(path), path, _density_question(density))
        yield from _squashed(scene, name)


def _density_question(density: float) -> str:
    unit, factor = ("g/cm^3", 1e3) if density < LIGHT else ("g/m^3", 1e-3)
    than = "less than any foam has" if density < LIGHT else "more than any metal has"
    meant = f"; is it in {unit}? then give {factor * density:.6g}" if LIGHT <= factor * density <= HEAVY else ""
    return f"{density:.6g} kg/m^3 is {than}{meant}"


def _squashed(scene: Scene, name: str) -> Iterator[Problem]:
    """Yield a warning for a body whose weight is more than its material carries: rho g H > E."""
    body = scene.bodies[name]
    law: Any = body.material.elastic.value
    moduli, size = moduli_of(law), _size(body.whole())
    if moduli is None or not np.isfinite(size).all():
        return
    young = moduli.young
    weight = body.material.density * float(np.abs(scene.world.gravity) @ size)
    if weight > young:
        path, given = f"bodies.{name}.material.elastic.{body.material.elastic.name}", hasattr(law, "youngs_modulus")
        path, modulus = (f"{path}.youngs_modulus", f"{young:.4g}") if given else (path, f"E = {young:.4g}")
        message = (
            f"{modulus} Pa is less than the body's weight per area, {weight:.4g} Pa (density x gravity x height), "
            "which will flatten it: check the units of the modulus, the density and the lengths"
        )
        yield Problem(scene.where(path), path, message)


def in_si(scene: Scene) -> bool:
    """Return whether a scene uses SI units, as far as its gravity or else its stiffness shows."""
    gravity = float(np.linalg.norm(scene.world.gravity))
    if gravity > 0:
        return STANDARD_GRAVITY[0] <= gravity <= STANDARD_GRAVITY[1]
    laws = [moduli_of(body.material.elastic.value) for body in scene.bodies.values() if not body.unit_mass]
    return max((moduli.young for moduli in laws if moduli is not None), default=0.0) >= SOFTEST


def require_possible_plan(scene: Scene, limits: list[Limit]) -> None:
    """Raise a SceneError if a run would have too many substeps; it names the part that asks for them.

    Questions about units follow, because another unit is the likely cause.

    Args:
        limits: the bounds on the substep.
    """
    time = scene.time
    count = time.control_steps * int(time.substeps)
    if count <= MOST_SUBSTEPS_IN_A_RUN:
        return
    least = min(limits, key=lambda limit: limit.dt)
    needed = time.duration / least.dt
    if time.control_steps > MOST_SUBSTEPS_IN_A_RUN or needed <= MOST_SUBSTEPS_IN_A_RUN / 10:
        path = "time.control_step" if time.control_steps > MOST_SUBSTEPS_IN_A_RUN else "time.substeps"
        cause = f"{time.control_steps:,} control steps of {int(time.substeps):,} substeps"
    else:
        path = least.part if "." in least.part else "time.duration"
        cause = f"its largest stable substep is {least.dt:.3g} s, in a run of {time.duration:g} s"
    message = (
        f"asks for a run of {count:,} substeps, more than {MOST_SUBSTEPS_IN_A_RUN:,}: {cause}; check its numbers and "
        "their units, use a larger dx or a shorter run"
    )
    raise SceneError([Problem(scene.where(path), path, message), *unit_questions(scene)])


def _size(shape: Shape) -> Array:
    """Return the edge lengths of a shape's bounds (D,) [m]."""
    lower, upper = shape.bounds()
    with np.errstate(over="ignore", invalid="ignore"):  # beyond what numbers hold, or infinite
        return np.asarray(upper - lower)


def _product(size: Array | list[float]) -> str:
    return " x ".join(f"{edge:.4g}" for edge in size)


def _point(x: Array) -> str:
    return "(" + ", ".join(f"{c + 0.0:.4g}" for c in x) + ")"

"""Bodies that hardly change their volume: with volumes of its own for each particle, they resist bending too much."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from cqrun.build.raster import Raster
from cqrun.errors import Problem
from cqrun.materials.moduli import moduli_of
from cqrun.materials.term import has_volume
from cqrun.scene.body import Body
from cqrun.scene.load_path import values_of
from cqrun.scene.paths import canonical
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import bounds_of

RATIO, BULK = "poissons_ratio", "bulk_modulus"

NEARLY_INCOMPRESSIBLE = 0.49
"""Poisson's ratio from which a beam of 8 cells bends 3 % too little with local volumes."""


def averages(scene: Scene) -> bool:
    """Return whether volumes are means over the corners of cells."""
    if scene.world.volume != "auto":
        return scene.world.volume == "averaged"
    stiff = any(ratio >= NEARLY_INCOMPRESSIBLE for _, ratio in _ratios(scene))
    return stiff and scene.world.frame == "reference" and all(map(can_average, scene.bodies.values()))


def can_average(body: Body) -> bool:
    """Return whether a body's elastic law says which part of its energy is that of the volume."""
    spec: Any = body.material.elastic.value
    return has_volume(type(spec.kernel_term(np.zeros((len(spec.parameters), 1)))))


def volume_problems(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield the path of elastic laws whose volumes cannot be averaged, and why."""
    for name, body in scene.bodies.items() if scene.world.volume == "averaged" else ():
        if not can_average(body):
            yield (
                f"bodies.{name}.material.elastic.{body.material.elastic.name}",
                "has no energy of the volume alone, so volumes cannot be averaged: register one with "
                "`register_volume`, or set `world.volume: local`",
            )


def bends_too_little(ratio: float, cells: float) -> float:
    """Return the part of its sag that a beam loses to particles that each keep their own volume.

    1 / (1 - lost) = 1 + 0.0312 (K / mu)^0.514 / cells^0.81, within 0.03 of `benchmarks/measured/locking.csv`: 2 to 8
    cells, nu 0.45 to 0.4999.
    """
    bulk = 2.0 * (1.0 + ratio) / (3.0 * (1.0 - 2.0 * ratio))
    return float(1.0 - 1.0 / (1.0 + 0.0312 * bulk**0.514 / cells**0.81))


def locking_bodies(scene: Scene, rasters: Mapping[str, Raster]) -> Iterator[Problem]:
    """Yield a warning for each body that is nearly incompressible, if volumes are not averaged."""
    if averages(scene):
        return
    if scene.world.frame == "updated":
        asks = "`world.frame: reference` mends this"
    elif scene.world.volume == "local":
        asks = "`world.volume: averaged` mends this"
    else:
        asks = "a law with `register_volume` would mend this"
    for path, ratio in _ratios(scene):
        if ratio >= NEARLY_INCOMPRESSIBLE:
            cells = float(rasters[path.split(".")[1]].thickness) / scene.world.dx
            lost = bends_too_little(ratio, cells)
            message = (
                f"a Poisson's ratio of {ratio:.5g} is nearly incompressible, and particles that each keep their own "
                f"volume bend too little: a beam of this thickness, {cells:.2g} cells, bends about {lost:.0%} less "
                f"than it should; {asks}"
            )
            yield Problem(scene.where(path), path, message)


def _ratios(scene: Scene) -> Iterator[tuple[str, float]]:
    """Yield the path that sets the Poisson's ratio of each body or part of it, and the largest ratio it may have."""
    for name, body in scene.bodies.items():
        law: Any = body.material.elastic.value
        key = next((key for key in (RATIO, BULK) if getattr(law, key, None) is not None), None)
        inside = f"elastic.{body.material.elastic.name}.{key}"
        found = {f"bodies.{name}.material.{inside}": getattr(law, key, 0.0)} if key else {}
        for part, other in body.material_of.items() if key else ():
            if (value := other.value(inside)) is not None:
                found[f"bodies.{name}.material_of.{part}.{inside}"] = value
        for path, value in found.items():
            largest = max(value, *(bounds_of(scene, path) or (value,)), _along(scene).get(path, value))
            yield path, largest if key == RATIO else _ratio_of(law, largest)


def _along(scene: Scene) -> dict[str, float]:
    """Return the largest value of each Poisson's ratio or bulk modulus on a path of loads, by its path."""
    keys = [key for key in scene.path if key.endswith((RATIO, BULK))]
    return {canonical(scene, key): max(values_of(scene.path[key])) for key in keys}


def _ratio_of(law: Any, bulk: float) -> float:
    """Return Poisson's ratio at rest of a law with another bulk modulus."""
    moduli = moduli_of(law.model_copy(update={BULK: bulk}))
    return 0.0 if moduli is None else moduli.ratio

"""Bodies that hardly change their volume: with volumes of its own for each particle, they resist bending too much."""

from __future__ import annotations

from collections.abc import Iterator

from cqrun.errors import Problem
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import bounds_of

NEARLY_INCOMPRESSIBLE = 0.49
"""Poisson's ratio from which a beam of 8 cells bends 5 % too little with local volumes."""


def locking_bodies(scene: Scene) -> Iterator[Problem]:
    """Yield a warning for each body whose volumes should be averaged and are not."""
    if scene.world.volume == "averaged":
        return
    for name, body in scene.bodies.items():
        law = body.material.elastic
        path = f"bodies.{name}.material.elastic.{law.name}.poissons_ratio"
        ratio = getattr(law.value, "poissons_ratio", 0.0)
        ratio = max(ratio, *(bounds_of(scene, path) or (ratio,)))
        if ratio >= NEARLY_INCOMPRESSIBLE:
            here = scene.world.frame == "reference"
            asks = "`world.volume: averaged`" if here else "`world: {frame: reference, volume: averaged}`"
            message = (
                f"{ratio:g} is nearly incompressible, and particles that each keep their own volume bend too little: "
                f"at 0.499 a beam of 8 cells bends a quarter less than it should; {asks} mends this"
            )
            yield Problem(scene.where(path), path, message)

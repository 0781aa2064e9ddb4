"""Check materials before a run: laws that lose stability, and stresses that relax too fast or too slowly."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cqrun.build.history import fields_of
from cqrun.build.volumes import can_average
from cqrun.errors import Problem
from cqrun.materials.curves import nominal_slope, stable_to
from cqrun.materials.moduli import moduli_of
from cqrun.scene.material import Material, RegionMaterial
from cqrun.scene.schema import Scene

BEFORE = 0.995
"""Part of the stretch at which a law fails, where its slope tells why: no force beyond it, or one without bound."""

STABLE = 2.0
"""A law that loses stability below this stretch is warned about: soft robots stretch so far."""

LONG = 10.0
"""A branch that relaxes in a run by less than 10 % is warned about."""


def material_warnings(scene: Scene) -> Iterator[Problem]:
    """Yield warnings about laws that are unstable in tension, and about relaxation times."""
    for name, body in scene.bodies.items():
        for place, material in body.materials.items():
            for path, message in (*_unstable(material), *_out_of_time(scene, material)):
                where = f"bodies.{name}.{place}.{path}"
                yield Problem(scene.where(where), where, message)


def relaxation_problems(scene: Scene) -> Iterator[Problem]:
    """Yield why a stress that relaxes cannot be computed: in float32, or with a law that does not tell its U(J)."""
    slow = [
        (name, body, key)
        for name, body in scene.bodies.items()
        for key, term in body.material.terms.items()
        if _relaxes(term, scene)
    ]
    if scene.precision == "float32" and slow:
        message = (
            f"is float32, but the stress of '{slow[0][0]}' relaxes in each substep by less than its last digit there: "
            "use float64"
        )
        yield Problem(scene.where("precision"), "precision", message)
    for name, body, key in slow:
        if not can_average(body):
            path, law = f"bodies.{name}.material.{key}", body.material.elastic.name
            message = (
                f"relaxes what `{law}` answers to a change of shape, but its file does not say which part of its "
                "energy is that of the volume: add `register_volume`"
            )
            yield Problem(scene.where(path), path, message)


def _relaxes(term: Any, scene: Scene) -> bool:
    return bool(term.relaxes and fields_of(term, scene.dim))


def _unstable(material: Material | RegionMaterial) -> Iterator[tuple[str, str]]:
    """Yield a law with a test in which its force falls while it is stretched (Drucker)."""
    elastic = material.elastic
    if elastic is None:
        return
    law: Any = elastic.value
    if moduli_of(law) is None:
        return
    theta = np.array([getattr(law, name) for name in law.parameters])
    stable = stable_to(law, theta)
    mode, end = min(stable.items(), key=lambda item: item[1])
    if end < STABLE:
        first, last = nominal_slope(law, theta, mode, np.array([1.0, BEFORE * end]))
        farther = "a body that is stretched farther gives way at once"
        if last >= first:
            farther = "no body can be stretched farther, because its stress grows without bound there"
        what = "has its largest force" if last < first else "reaches its limit"
        yield (
            f"elastic.{elastic.name}",
            f"{what} in {mode} tension at a stretch of {end:.3g}: {farther}; check the numbers, or keep below that "
            "stretch",
        )


def _out_of_time(scene: Scene, material: Material | RegionMaterial) -> Iterator[tuple[str, str]]:
    """Yield relaxation times that are shorter than a substep, or much longer than the run."""
    if scene.time is None or scene.time.substeps == "auto":
        return
    dt = scene.time.control_step / int(scene.time.substeps)
    for key, term in material.terms.items():
        times = getattr(term, "times", ()) if term.relaxes else ()  # type: ignore[attr-defined]  # a term, by its kind
        for k, time in enumerate(times, 1):
            if time < dt:
                yield f"{key}.time_{k}", f"{time:g} s is shorter than a substep of {dt:.3g} s: the branch has no effect"
            elif time > LONG * scene.time.duration:
                yield (
                    f"{key}.time_{k}",
                    f"{time:g} s is more than {LONG:g} times as long as the run: the branch only makes the body "
                    "stiffer",
                )

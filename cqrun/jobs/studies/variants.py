"""Variants of a design: in each, some groups of unknowns are free and the others are fixed at their start values."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from cqrun.build.check_design import differ
from cqrun.errors import UsageError
from cqrun.jobs import control
from cqrun.scene.paths import canonical, leaf, shapes_a_body
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import start, tied

MOST_GROUPS = 3
"""With more groups, all combinations are too many runs; then none, each alone, and all are compared."""

CONTROL, ALL = "control", "all"


@dataclass(frozen=True)
class Variant:
    """A variant: its name, its free groups, and the overrides that make it from the scene."""

    name: str
    groups: tuple[str, ...]
    overrides: tuple[str, ...]

    @property
    def job(self) -> control.Learning:
        """The job that runs it."""
        return control.CODESIGN if self.groups else control.CONTROL


def group_of(path: str) -> str:
    """Return the last name in an unknown's path: `size` of `bodies.arm.shape.box.size.1`."""
    return [key for key in path.split(".") if not key.isdigit()][-1]


def variants_of(scene: Scene) -> list[Variant]:
    """Return the variants of a scene, control alone first and all unknowns last; UsageError without unknowns."""
    if not scene.unknowns:
        raise UsageError("--ablate compares unknowns of a design: this scene has no `unknowns`")
    if not scene.objective:
        raise UsageError("--ablate compares the first term of the objective: this scene has no `objective`")
    paths = list(scene.unknowns)
    for path in paths:
        _require_same_bodies(scene, path)
    groups = list(dict.fromkeys(group_of(canonical(scene, path)) for path in paths))
    chosen: list[tuple[str, ...]] = [(), *((group,) for group in groups)]
    if len(groups) <= MOST_GROUPS:
        chosen = [free for k in range(len(groups) + 1) for free in itertools.combinations(groups, k)]
    elif len(groups) > 1:
        chosen.append(tuple(groups))
    variants = []
    for free in chosen:
        fixed = [path for path in paths if group_of(canonical(scene, path)) not in free]
        name = CONTROL if not free else ALL if len(free) == len(groups) > 1 else " + ".join(free)
        starts = [f"{p}={value!r}" for path in fixed for p, value in tied(scene, path, start(scene, path)).items()
                  if differ(value, leaf(scene, p).value)]  # fmt: skip
        variants.append(Variant(name, free, (*(f"unknowns.{path}=null" for path in fixed), *starts)))
    return variants


def _require_same_bodies(scene: Scene, path: str) -> None:
    """Raise UsageError if fixing an unknown at its start value would give other bodies than the scene's.

    A changed shape is sampled again. For an unknown per group, particles without a group would get the start value too.
    """
    for other, value in tied(scene, path, start(scene, path)).items():
        given, groups = leaf(scene, other).value, scene.unknowns[path].per == "group"
        if (shapes_a_body(other) or groups) and differ(value, given):
            change = "other values in particles without a group" if groups else "other particles"
            raise UsageError(
                f"--ablate: '{other}' starts at {value:g}, but the scene has {given:g}; variants that fix it would "
                f"have {change}: set this value in the scene, -o {other}={value:g}"
            )


def rate_overrides(scene: Scene, rates: Sequence[float]) -> list[str | None]:
    if not rates:
        return [None]
    if scene.optimizer is None or not hasattr(scene.optimizer.value, "learning_rate"):
        name = "none" if scene.optimizer is None else scene.optimizer.name
        raise UsageError(f"--rate: the scene's optimizer, {name}, has no learning_rate: remove --rate")
    return [f"optimizer.{scene.optimizer.name}.learning_rate={rate!r}" for rate in rates]

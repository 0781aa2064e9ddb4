"""What a scene's parts must agree on: the dimension, and the names they use for each other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from pydantic_core import InitErrorDetails

from cqrun.explain import KEY, Loc, finding
from cqrun.scene.region_names import findings_of_regions, unknown
from cqrun.scene.walk import parts

if TYPE_CHECKING:
    from cqrun.scene.schema import Scene


def findings_between(scene: Scene) -> list[InitErrorDetails]:
    """Return what does not fit together."""
    found = [
        finding(message, (*loc, *place))
        for loc, part in parts(scene)
        for place, message in part.dim_problems(scene.dim)
    ]
    return [*found, *_faces(scene), *_bodies(scene), *findings_of_regions(scene), *_signals(scene), *_target(scene)]


def _faces(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield every `face` that a 2D world has not."""
    for loc, part in parts(scene):
        face = getattr(part, "face", None)
        if scene.dim == 2 and isinstance(face, str) and face.startswith("z_"):
            yield finding(f"a 2D world has no face {face}", (*loc, "face"))


def _bodies(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield every `body` that names none of the scene's."""
    for loc, part in parts(scene):
        name = getattr(part, "body", None)
        if isinstance(name, str) and name not in scene.bodies:
            yield finding(unknown("body", name, list(scene.bodies)), (*loc, "body"))


def _signals(scene: Scene) -> Iterator[InitErrorDetails]:
    if scene.activation is None:
        return
    for name in scene.activation.signals or {}:
        if name not in scene.actuators:
            place: Loc = ("activation", "signals", name)
            yield finding(unknown("actuator", name, list(scene.actuators)), place, kind=KEY)
    if scene.activation.random is not None and not scene.actuators:
        yield finding("has no actuator to drive", ("activation", "random"))


def _target(scene: Scene) -> Iterator[InitErrorDetails]:
    target = scene.data.target if scene.data is not None else None
    if target is not None and target.time > scene.time.duration * (1 + 1e-9):
        message = f"{target.time:g} s is after the end of the run at {scene.time.duration:g} s"
        yield finding(message, ("data", "target", "time"))

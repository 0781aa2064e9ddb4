"""What a scene's parts must agree on: the dimension, and the names they use for each other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic_core import InitErrorDetails

from cqrun.explain import KEY, Loc, finding, listed
from cqrun.scene.activation import Activation
from cqrun.scene.region_names import findings_of_regions, unknown
from cqrun.scene.sections import Sections
from cqrun.scene.walk import parts

PICKING = ("observers", "objective", "constraints")
"""Parts whose groups are particles that are picked once, so that a region of the scene does as well."""

TAKEN = ("iteration", "loss", "growth_at", "regulariser", "violation", "kkt", "seconds")
"""Columns of history.csv beside those of the objective's terms."""


def findings_between(scene: Sections) -> list[InitErrorDetails]:
    """Return what does not fit together."""
    found = [
        finding(message, (*loc, *place))
        for loc, part in parts(scene)
        for place, message in part.dim_problems(scene.dim)
    ]
    named = [*_faces(scene), *_bodies(scene), *_groups(scene), *findings_of_regions(scene), *_goals_named(scene)]
    named += _columns(scene)
    placed = [*_goals_unused(scene), *_goals_outside(scene), *_positions_outside(scene)]
    return [*found, *named, *_signals(scene), *_controller(scene), *placed, *_skipped(scene)]


def _faces(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield every `face` that a 2D world has not."""
    for loc, part in parts(scene):
        face = getattr(part, "face", None)
        if scene.dim == 2 and isinstance(face, str) and face.startswith("z_"):
            yield finding(f"a 2D world has no face {face}", (*loc, "face"))


def _bodies(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield every `body` that names none of the scene's."""
    for loc, part in parts(scene):
        name = getattr(part, "body", None)
        if isinstance(name, str) and name not in scene.bodies:
            yield finding(unknown("body", name, list(scene.bodies)), (*loc, "body"))


def _groups(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield every group that the body beside it has not; where particles are picked regions may be named as well."""
    for loc, part in parts(scene):
        for owner, key in (("body", "group"), ("body", "groups"), ("body", "each"), ("target", "target_group")):
            body, names = getattr(part, owner, None), getattr(part, key, None)
            if not isinstance(body, str) or body not in scene.bodies or names in (None, "all"):
                continue
            regions = scene.regions if key == "each" or {*loc[:1]} & {*PICKING} else ()
            legal = [*scene.bodies[body].group_names, *regions]
            listed = isinstance(names, list)
            for k, name in enumerate(names if listed else [names]):
                if name not in legal:
                    message = unknown(f"group of the body '{body}'", name, legal)
                    yield finding(message, (*loc, key, k) if listed else (*loc, key))


def _goals_named(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield every `goal` that names none of the scene's."""
    for loc, part in parts(scene):
        name = getattr(part, "goal", None)
        if isinstance(name, str) and name not in scene.goals:
            yield finding(unknown("goal", name, list(scene.goals)), (*loc, "goal"))


def _columns(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield terms whose column in history.csv would be another one's."""
    for name in scene.objective:
        if name in TAKEN:
            message = "history.csv has a column of this name already: give the term another name"
            yield finding(message, ("objective", name), kind=KEY)


def _goals_unused(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield goals that nothing asks for, as a misspelt one is."""
    named = {name for _, part in parts(scene) if isinstance(name := getattr(part, "goal", None), str)}
    if named:  # else there is nothing that could ask: a scene that is not finished, or a plug-in's own way
        for name in scene.goals:
            if name not in named:
                yield finding(
                    f"no part of the scene asks for it; goals that are asked for: {listed(sorted(named))}",
                    ("goals", name),
                )


def _positions_outside(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield places outside the world that an objective or a constraint wants a body to come to."""
    for loc, part in parts(scene):
        if not {*loc[:1]} & {"objective", "constraints"}:
            continue
        wanted: list[tuple[Loc, Any]] = [(("position",), getattr(part, "position", None))]
        for name in ("path", "keys"):
            wanted += [((name, k), point[1:]) for k, point in enumerate(getattr(part, name, None) or [])]
        for place, at in wanted:
            if isinstance(at, list) and len(at) == scene.dim:
                for k, size in enumerate(scene.world.size):
                    if not 0 <= at[k] <= size:
                        yield finding(_outside(k, f"{at[k]:g}", size), (*loc, *place))


def _outside(axis: int, reach: str, size: float) -> str:
    return f"lies outside the world: {'xyz'[axis]} = {reach} m; it holds 0 to {size:g} m, move it inside"


def _goals_outside(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield goals that are, or may be drawn, outside the world; one with fewer or more entries is no position."""
    for name, goal in scene.goals.items():
        if len(goal.position) != scene.dim:
            continue
        spread = goal.spread if goal.spread is not None else [0.0] * scene.dim
        for k, (at, half, size) in enumerate(zip(goal.position, spread, scene.world.size, strict=True)):
            if at - half < 0 or at + half > size:
                reach = f"{at:g}" if half == 0 else f"{at - half:g} to {at + half:g}"
                yield finding(_outside(k, reach, size), ("goals", name, "position"), involves=("spread",))


def _controller(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield what a controller cannot have beside it, or without it."""
    if scene.controller is None:
        return
    if scene.activation is not None:
        yield finding(
            f"the controller '{scene.controller.name}' drives the actuators already: remove one of the two",
            ("activation",), kind=KEY, involves=("controller",),
        )  # fmt: skip
    if not scene.actuators:
        yield finding("has no actuator to drive: say what it moves, in `actuators`", ("controller",), kind=KEY)


def _signals(scene: Sections) -> Iterator[InitErrorDetails]:
    if scene.activation is None:
        return
    for name in scene.activation.signals or {}:
        if name not in scene.actuators:
            place: Loc = ("activation", "signals", name)
            yield finding(unknown("actuator", name, list(scene.actuators)), place, kind=KEY)
    yield from _limits(scene, scene.activation)
    if scene.activation.random is not None and not scene.actuators:
        yield finding("has no actuator to drive", ("activation", "random"))


def _limits(scene: Sections, activation: Activation) -> Iterator[InitErrorDetails]:
    """Yield knots, or ends of a random range, beyond what an actuator takes."""
    for name, chosen in scene.actuators.items():
        low, high = chosen.value.limits  # type: ignore[attr-defined]
        asked: dict[Loc, float] = {}
        if activation.random is not None:
            asked = {("random", end): getattr(activation.random, end) for end in ("low", "high")}
        for k, knot in enumerate((activation.signals or {}).get(name, [])):
            asked["signals", name, k] = knot
        for place, a in asked.items():
            if not low <= a <= high:
                message = f"must be between {low:g} and {high:g}, the limits of the {chosen.name} '{name}', is {a:g}"
                yield finding(message, ("activation", *place))


def _skipped(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield recordings that skip all of a run of the scene's own duration; those with a `length` tell themselves."""
    for name, recording in scene.recordings.items():
        if recording.length is None and recording.skip >= scene.time.duration:
            message = f"skips {recording.skip:g} s of a run of {scene.time.duration:g} s: nothing is left to compare"
            yield finding(message, ("data", "recordings", name, "skip"))

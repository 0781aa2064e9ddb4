"""Check that the parts of a scene agree on its dimension, and on the names by which they refer to each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic_core import InitErrorDetails

from cqrun.explain import KEY, VALUE, Loc, finding, listed
from cqrun.plugin.reference import (
    InWorld,
    NamesActuator,
    NamesBody,
    NamesBoundary,
    NamesFace,
    NamesForce,
    NamesGoal,
    NamesMeasure,
    NamesRigid,
)
from cqrun.scene.activation import Activation
from cqrun.scene.region_names import findings_of_regions, unknown
from cqrun.scene.sections import Sections
from cqrun.scene.walk import marked, parts

TAKEN = ("iteration", "loss", "growth_at", "regulariser", "violation", "kkt", "seconds")
"""Columns of history.csv that no term of the objective may use as its name."""


OF_MOTION = {
    "time": "a column of measurements.csv", "point": "a column of measurements.csv", "x": "the array of positions",
    "v": "the array of velocities", "F": "the array of deformation gradients", "activation": "the array of activations",
}  # fmt: skip
"""What else is called so in tables and in losses of one's own, so that no measured quantity may be."""


def findings_between(scene: Sections) -> list[InitErrorDetails]:
    """Return the findings about parts that do not fit together."""
    found = [
        finding(message, (*loc, *place))
        for loc, part in parts(scene)
        for place, message in part.dim_problems(scene.dim)
    ]
    named = [*_faces(scene), *_names(scene), *_rigid_names(scene), *findings_of_regions(scene), *_columns(scene)]
    placed = [*_goals_unused(scene), *_goals_outside(scene), *_positions_outside(scene)]
    return [*found, *named, *_signals(scene), *_controller(scene), *placed, *_skipped(scene)]


def _faces(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield every face that a 2D world does not have."""
    for found in marked(scene, NamesFace):
        if scene.dim == 2 and found.value.startswith("z_"):
            yield finding(f"a 2D world has no face {found.value}", found.loc)


def _names(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield every name of a body, goal, actuator, force, boundary or measured quantity that the scene does not have."""
    kinds: dict[str, tuple[type[Any], Mapping[str, Any]]] = {
        "body": (NamesBody, scene.bodies),
        "goal": (NamesGoal, scene.goals),
        "actuator": (NamesActuator, scene.actuators),
        "force": (NamesForce, scene.forces),
        "rigid body": (NamesRigid, scene.rigid),
        "boundary": (NamesBoundary, {**scene.boundaries, **scene.rigid}),
        "measured quantity": (NamesMeasure, scene.measure),
    }
    for kind, (mark, legal) in kinds.items():
        for found in marked(scene, mark):
            if found.value not in legal:
                message = unknown(kind, found.value, list(legal))
                yield finding(message, found.loc, kind=KEY if found.at_key else VALUE)


def _rigid_names(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield rigid bodies with the name of a boundary or a soft body: terms and tables name all of them alike."""
    for name in scene.rigid:
        for kind, others in (("boundary", scene.boundaries), ("body", scene.bodies)):
            if name in others:
                yield finding(f"a {kind} has this name too: give the rigid body another one", ("rigid", name), kind=KEY)


def _columns(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield terms and quantities whose name is already that of something else in tables."""
    for name in scene.objective:
        if name in TAKEN:
            message = "history.csv already has a column of this name: give the term another name"
            yield finding(message, ("objective", name), kind=KEY)
    for name in scene.measure:
        if name in OF_MOTION:
            message = f"{OF_MOTION[name]} has this name: give the quantity another one"
            yield finding(message, ("measure", name), kind=KEY)


def _goals_unused(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield goals that no part of the scene uses, for example because a name is misspelt."""
    named = {found.value for found in marked(scene, NamesGoal)}
    if named:  # if no goal is used at all, the scene is unfinished, or a plug-in uses goals in another way
        for name in scene.goals:
            if name not in named:
                yield finding(
                    f"no part of the scene uses it; goals that are used: {listed(sorted(named))}",
                    ("goals", name),
                )


def _positions_outside(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield target positions that are outside the world."""
    for found in marked(scene, InWorld):
        at = found.value[found.mark.first :]
        for k, (place, size) in enumerate(zip(at, scene.world.size, strict=False)):
            if len(at) == scene.dim and not 0 <= place <= size:
                yield finding(_outside(k, f"{place:g}", size), found.loc)


def _outside(axis: int, reach: str, size: float) -> str:
    return f"lies outside the world: {'xyz'[axis]} = {reach} m; it holds 0 to {size:g} m, move it inside"


def _goals_outside(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield goals whose range leaves the world; a goal is a position if it has one entry per dimension."""
    for name, goal in scene.goals.items():
        if len(goal.position) != scene.dim:
            continue
        spread = goal.spread if goal.spread is not None else [0.0] * scene.dim
        for k, (at, half, size) in enumerate(zip(goal.position, spread, scene.world.size, strict=True)):
            if at - half < 0 or at + half > size:
                reach = f"{at:g}" if half == 0 else f"{at - half:g} to {at + half:g}"
                yield finding(_outside(k, reach, size), ("goals", name, "position"), involves=("spread",))


def _controller(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield conflicts of a controller: it excludes open-loop signals, and it needs actuators."""
    if scene.controller is None:
        return
    if scene.activation is not None:
        yield finding(
            f"the controller '{scene.controller.name}' already drives the actuators: remove one of the two",
            ("activation",), kind=KEY, involves=("controller",),
        )  # fmt: skip
    if not scene.actuators:
        yield finding("has no actuator to drive: add one to `actuators`", ("controller",), kind=KEY)


def _signals(scene: Sections) -> Iterator[InitErrorDetails]:
    if scene.activation is None:
        return
    yield from _limits(scene, scene.activation)
    if scene.activation.random is not None and not scene.actuators:
        yield finding("has no actuator to drive", ("activation", "random"))


def _limits(scene: Sections, activation: Activation) -> Iterator[InitErrorDetails]:
    """Yield knots, and ends of a random range, that are outside an actuator's limits."""
    for name, chosen in scene.actuators.items():
        low, high = chosen.value.limits  # type: ignore[attr-defined]
        activations: dict[Loc, float] = {}
        if activation.random is not None:
            activations = {("random", end): getattr(activation.random, end) for end in ("low", "high")}
        for k, knot in enumerate((activation.signals or {}).get(name, [])):
            activations["signals", name, k] = knot
        for place, a in activations.items():
            if not low <= a <= high:
                message = f"must be between {low:g} and {high:g}, the limits of the {chosen.name} '{name}', is {a:g}"
                yield finding(message, ("activation", *place))


def _skipped(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield recordings that skip the whole run; a recording with a `length` checks this itself."""
    for name, recording in scene.recordings.items():
        if recording.length is None and recording.skip >= scene.time.duration:
            message = f"skips {recording.skip:g} s of a run of {scene.time.duration:g} s: nothing is left to compare"
            yield finding(message, ("data", "recordings", name, "skip"))

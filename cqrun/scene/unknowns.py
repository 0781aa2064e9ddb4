"""Paths that a scene's job names: unknowns that can be found, truths and overrides that can be set."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from pydantic_core import InitErrorDetails

from cqrun.errors import SceneError
from cqrun.explain import KEY, Loc, finding, listed, suggest
from cqrun.plugin.reference import body_of as named_body
from cqrun.scene.data import Unknown
from cqrun.scene.paths import LeafInfo, canonical, leaf, leaves, with_values
from cqrun.scene.schema import Scene


def start(scene: Scene, path: str) -> float:
    """Return where an unknown starts: its `initial`, else the scene's own value."""
    initial = scene.unknowns[path].initial
    return float(leaf(scene, path).value if initial is None else initial)


def tied(scene: Scene, path: str, value: float) -> dict[str, float]:
    """Return the values of an unknown and of what follows it, by path in its long spelling."""
    others = {canonical(scene, other): tie for other, tie in scene.unknowns[path].also.items()}
    return {canonical(scene, path): value, **{p: tie.factor * value + tie.offset for p, tie in others.items()}}


def starts(scene: Scene) -> dict[str, float]:
    """Return where every unknown, and what follows it, starts, by path in its long spelling."""
    return {p: value for path in scene.unknowns for p, value in tied(scene, path, start(scene, path)).items()}


def truths(scene: Scene) -> dict[str, float]:
    """Return the values that synthetic data are made with, by path in its long spelling.

    What follows an unknown follows its true value, unless it has one itself.
    """
    made = scene.synthetic
    own = {} if made is None else {canonical(scene, path): value for path, value in made.truth.items()}
    names = {path: canonical(scene, path) for path in scene.unknowns}
    followed = [tied(scene, path, own[name]) for path, name in names.items() if name in own]
    return {p: value for each in [*followed, own] for p, value in each.items()}


def bounds_of(scene: Scene, path: str) -> tuple[float, float] | None:
    """Return the bounds of a value that is an unknown, or follows one; None if it does neither."""
    name = canonical(scene, path)
    for unknown, spec in scene.unknowns.items():
        ends = [tied(scene, unknown, bound) for bound in spec.bounds]
        if name in ends[0]:
            return min(end[name] for end in ends), max(end[name] for end in ends)
    return None


def body_of(scene: Scene, name: str) -> str:
    """Return the body whose particles a value at a path, in its long spelling, belongs to; empty if there is none."""
    keys = name.split(".")
    if keys[0] == "actuators":
        return named_body(scene.actuators[keys[1]].value) or ""
    return keys[1] if keys[0] == "bodies" else ""


def groups_of(scene: Scene, path: str) -> tuple[str, ...]:
    """Return the names of the groups of the body that a value at a path belongs to."""
    body = body_of(scene, canonical(scene, path))
    return scene.bodies[body].group_names if body else ()


def findings_of_paths(scene: Scene) -> list[InitErrorDetails]:
    """Return what is wrong with the unknowns, the synthetic truth and the recordings' overrides."""
    found = [item for path, unknown in scene.unknowns.items() for item in _unknown(scene, path, unknown)]
    return [*found, *_twice(scene), *_held_out(scene), *_truth(scene), *_overrides(scene)]


def _unknown(scene: Scene, path: str, unknown: Unknown) -> Iterator[InitErrorDetails]:
    place: Loc = ("unknowns", path)
    try:
        info = leaf(scene, path)
    except SceneError as error:
        yield finding(error.problems[0].message, place, kind=KEY)
        return
    if not info.differentiable:
        reached = list(leaves(scene, differentiable=True))
        message = f"no gradient reaches it{suggest(path, reached)}; unknowns can be: {listed(reached)}"
        yield finding(message, place, kind=KEY)
        return
    followers = list(_followers(scene, path, unknown))
    yield from followers or _bounds(scene, path, unknown, info)
    yield from _per(scene, path, unknown)


def _followers(scene: Scene, path: str, unknown: Unknown) -> Iterator[InitErrorDetails]:
    """Yield what cannot follow an unknown."""
    keys = canonical(scene, path).split(".")
    for other in unknown.also:
        place: Loc = ("unknowns", path, "also", other)
        try:
            info = leaf(scene, other)
        except SceneError as error:
            yield finding(error.problems[0].message, place, kind=KEY)
            continue
        same = info.path.split(".")
        if not info.differentiable:
            reached = list(leaves(scene, differentiable=True))
            yield finding(f"no gradient reaches it{suggest(other, reached)}", place, kind=KEY)
        elif unknown.per != "body" and same[:1] + same[2:] != keys[:1] + keys[2:]:
            message = f"`per: {unknown.per}` can be tied to the same value of another body only"
            yield finding(message, place, kind=KEY)
        elif unknown.per != "body" and (message := _held_by_parts(scene, same)):
            yield finding(message, place, kind=KEY)


def _bounds(scene: Scene, path: str, unknown: Unknown, info: LeafInfo) -> Iterator[InitErrorDetails]:
    place: Loc = ("unknowns", path)
    for i, bound in enumerate(unknown.bounds):
        try:
            with_values(scene, tied(scene, path, bound))
        except SceneError as error:
            wrong = error.problems[0]
            whose = f"by `also`, {wrong.path}" if wrong.path in unknown.also else "the value"
            yield finding(f"the bounds reach {bound:g}, but {whose} {wrong.message}", (*place, "bounds", i))
    lower, upper = unknown.bounds
    value = start(scene, path)
    if not lower <= value <= upper:
        key, what, advice = "bounds", "the scene's own value", "widen them or give `initial`"
        if unknown.initial is not None:
            key, what, advice = "initial", "the start", "move it or widen the bounds"
        message = f"{what} {value:g} {_unit(info)}lies outside the bounds {lower:g} to {upper:g}: {advice}"
        yield finding(message, (*place, key), involves=("bounds", "initial"))


def _unit(info: LeafInfo) -> str:
    return "" if info.unit == "1" else f"{info.unit} "


def _per(scene: Scene, path: str, unknown: Unknown) -> Iterator[InitErrorDetails]:
    if unknown.per == "body":
        return
    keys = canonical(scene, path).split(".")
    place: Loc = ("unknowns", path, "per")
    is_weight = keys[0] == "actuators" and keys[-1] == "weight"
    body = body_of(scene, ".".join(keys))
    if not is_weight and (keys[0] != "bodies" or keys[2] != "material"):
        how = "be a field" if unknown.per == "field" else f"differ by {unknown.per}"
        advice = "use `per: body`"
        if keys[0] == "actuators":
            weight = ".".join([*keys[:-1], "weight"])
            advice += f", or the unknown '{weight}', the share of its strength that each particle has"
        yield finding(f"only a body's material, and an actuator's `weight`, can {how}; {advice}", place)
    elif unknown.per == "group" and not scene.bodies[body].group_names:
        yield finding(f"the body '{body}' has no groups; name some or use `per: body`", place)
    elif not is_weight and (message := _held_by_parts(scene, keys)):
        yield finding(message, place)


def _held_by_parts(scene: Scene, keys: Sequence[str]) -> str:
    """Return what is wrong with values a particle of a body's material where parts have their own, or nothing."""
    if keys[0] != "bodies" or keys[2:3] != ["material"]:
        return ""
    others = scene.bodies[keys[1]].material_of
    own = [name for name, other in others.items() if other.value(".".join(keys[3:])) is not None]
    return f"by material_of, {listed(own)} have a value of their own: remove it, or use `per: body`" if own else ""


def _twice(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield unknowns that are another one in another spelling, or follow one; equal spellings are duplicate keys."""
    first: dict[str, str] = {}
    named: list[tuple[Loc, str]] = [(("unknowns", path), path) for path in scene.unknowns]
    for path, unknown in scene.unknowns.items():
        named += [(("unknowns", path, "also", other), other) for other in unknown.also]
    for place, path in named:
        try:
            name = canonical(scene, path)
        except SceneError:
            continue  # no such path: told above
        if name in first:
            yield finding(f"is the same value as the unknown '{first[name]}': name it once", place, kind=KEY)
        first.setdefault(name, path)


def _held_out(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield unknown starts of recordings that nothing is fitted to."""
    for name, recording in scene.recordings.items():
        path = f"data.recordings.{name}.start"
        message = f"the recording '{name}' is held out, so nothing tells its start: remove this unknown"
        for unknown, spec in scene.unknowns.items() if recording.holdout else ():
            if unknown == path:
                yield finding(message, ("unknowns", path), kind=KEY)
            elif path in spec.also:
                yield finding(message, ("unknowns", unknown, "also", path), kind=KEY)


def _truth(scene: Scene) -> Iterator[InitErrorDetails]:
    for path, value in (scene.synthetic.truth if scene.synthetic is not None else {}).items():
        place: Loc = ("data", "synthetic", "truth", path)
        try:
            info = leaf(scene, path)
        except SceneError as error:
            yield finding(error.problems[0].message, place, kind=KEY)
            continue
        if not info.differentiable or path.startswith("data."):
            yield finding("a truth can only be what can be an unknown: set it in the scene itself", place, kind=KEY)
            continue
        try:
            with_values(scene, {info.path: value})
        except SceneError as error:
            yield finding(error.problems[0].message, place)


def _overrides(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield overrides of recordings that their scene refuses, each tried alone, then all together."""
    for name, recording in scene.recordings.items():
        place: Loc = ("data", "recordings", name, "overrides")
        useless = list(_without_effect(scene, place, list(recording.overrides)))
        if useless:
            yield from useless
            continue
        refused = list(_refused(scene, place, {path: {path: v} for path, v in recording.overrides.items()}))
        yield from refused
        if len(recording.overrides) > 1 and not refused:
            yield from _refused(scene, place, {"": recording.overrides})


FIXED = ("data", "unknowns", "optimizer", "time", "job", "title", "seed", "memory", "precision", "cqrun")
"""What all recordings of a scene share: no recording can have its own."""


def _without_effect(scene: Scene, place: Loc, paths: list[str]) -> Iterator[InitErrorDetails]:
    """Yield overrides that would do nothing: of what all recordings share, and of what is fitted."""
    for path in paths:
        head = path.split(".")[0]
        named = {name: [name, *spec.also] for name, spec in scene.unknowns.items()}
        fitted = [name for name, others in named.items() if any(_holds(scene, path, other) for other in others)]
        if head in FIXED:
            message = f"all recordings share `{head}`: an override can change bodies, loads, the world ..."
            yield finding(message, (*place, path))
        elif fitted:
            how = "is fitted, as" if _holds(scene, path, fitted[0]) else "follows"
            message = f"{how} the unknown '{fitted[0]}': a recording cannot have its own value"
            yield finding(message, (*place, path))


def _holds(scene: Scene, path: str, name: str) -> bool:
    """Say whether a path is a number, or a part of the scene that has it, in whichever spelling."""
    try:
        full = canonical(scene, name)
    except SceneError:
        return False  # told where it is named
    with contextlib.suppress(SceneError):  # of a part, which is no number
        path = canonical(scene, path)
    return any(other == path or other.startswith(f"{path}.") for other in (name, full))


def _refused(scene: Scene, place: Loc, trials: dict[str, dict[str, object]]) -> Iterator[InitErrorDetails]:
    for key, values in trials.items():
        try:
            with_values(scene, values)
        except SceneError as error:
            for problem in error.problems:
                told = problem.message if problem.path == key else f"{problem.path}: {problem.message}"
                yield finding(told, (*place, key) if key else place)

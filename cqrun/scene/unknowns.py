"""Check the key paths of unknowns, of synthetic truths and of the recordings' overrides, and look up their values."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic_core import InitErrorDetails

from cqrun.errors import SceneError
from cqrun.explain import KEY, Loc, finding, listed, suggest
from cqrun.measurements.placement import PLACED
from cqrun.plugin.reference import body_of as named_body
from cqrun.scene.data import Unknown
from cqrun.scene.keypath import own_path, split_own
from cqrun.scene.paths import FIXED, LeafInfo, canonical, leaf, leaves, require_possible, with_values
from cqrun.scene.schema import Scene


def start(scene: Scene, path: str) -> float:
    """Return the start value of an unknown: its `initial`, or else the scene's value."""
    initial = scene.unknowns[path].initial
    return float(leaf(scene, path).value if initial is None else initial)


def tied(scene: Scene, path: str, value: float) -> dict[str, float]:
    """Return the values of an unknown and of the values tied to it, by path in its long form."""
    others = {canonical(scene, other): tie for other, tie in scene.unknowns[path].also.items()}
    return {canonical(scene, path): value, **{p: tie.factor * value + tie.offset for p, tie in others.items()}}


def starts(scene: Scene) -> dict[str, float]:
    """Return the start values of all unknowns and of the values tied to them, by path in its long form."""
    return {p: value for path in scene.unknowns for p, value in tied(scene, path, start(scene, path)).items()}


def truths(scene: Scene) -> dict[str, float]:
    """Return the true values with which synthetic data are made, by path in its long form.

    A value that is tied to an unknown follows the true value of the unknown, unless it has a true value itself.
    """
    synthetic = scene.synthetic
    given = {} if synthetic is None else {canonical(scene, path): value for path, value in synthetic.truth.items()}
    names = {path: canonical(scene, path) for path in scene.unknowns}
    followed = [tied(scene, path, given[name]) for path, name in names.items() if name in given]
    return {p: value for each in [*followed, given] for p, value in each.items()}


def bounds_of(scene: Scene, path: str) -> tuple[float, float] | None:
    """Return the bounds of a value that is an unknown or is tied to one, or else None."""
    name = canonical(scene, path)
    for unknown, spec in scene.unknowns.items():
        ends = [tied(scene, unknown, bound) for bound in spec.bounds]
        if name in ends[0]:
            return min(end[name] for end in ends), max(end[name] for end in ends)
    return None


def scene_of_recording(scene: Scene, recording: str, values: Mapping[str, Any] | None = None) -> Scene:
    """Return the scene of one recording: its overrides are applied, and its own unknowns are unknowns of the scene.

    Args:
        values: what to change, by path; the recording's overrides if not given.

    Raises:
        SceneError: the scene refuses a value.
    """
    changed = with_values(scene, scene.recordings[recording].overrides if values is None else values)
    return changed.model_copy(update={"unknowns": _unknowns_in(scene, recording)})


def has_own_values(scene: Scene, recording: str) -> bool:
    """Return whether the scene of a recording differs from that of the others, or has unknowns of its own."""
    named = [split_own(path)[0] for _, path in _named(scene)]
    return bool(scene.recordings[recording].overrides) or recording in named


def own_unknowns(scene: Scene, recording: str) -> list[str]:
    """Return what is fitted for one recording alone: `start`, `offset.0`, `rotation.0`, or a path in its scene."""
    begin = f"data.recordings.{recording}."
    own = [path.removeprefix(begin) for _, path in _named(scene) if path.startswith(begin)]
    return [path.removeprefix("overrides.") for path in own]


def _unknowns_in(scene: Scene, recording: str) -> dict[str, Unknown]:
    """Return the unknowns of the scene of a recording, by path in that scene.

    A value that follows an unknown of another recording becomes an unknown with the bounds that it follows.
    """
    shared: dict[str, Unknown] = {}
    own: dict[str, Unknown] = {}
    for path, spec in scene.unknowns.items():
        whose, inside = split_own(path)
        also = {split_own(p)[1]: tie for p, tie in spec.also.items() if split_own(p)[0] in ("", recording)}
        if whose in ("", recording):
            (own if whose else shared)[inside] = spec.model_copy(update={"also": also})
            continue
        for other, tie in also.items():
            ends = sorted(tie.factor * bound + tie.offset for bound in spec.bounds)
            own[other] = Unknown(bounds=ends, initial=tie.factor * start(scene, path) + tie.offset)
    return {path: spec for path, spec in shared.items() if path not in own} | own


def body_of(scene: Scene, name: str) -> str:
    """Return the name of the body that a path, in its long form, belongs to; empty if there is none."""
    keys = name.split(".")
    if keys[0] == "actuators":
        return named_body(scene.actuators[keys[1]].value) or ""
    return keys[1] if keys[0] == "bodies" else ""


def groups_of(scene: Scene, path: str) -> tuple[str, ...]:
    """Return the names of the groups of the body that a path belongs to."""
    body = body_of(scene, canonical(scene, path))
    return scene.bodies[body].group_names if body else ()


def findings_of_paths(scene: Scene) -> list[InitErrorDetails]:
    """Return what is wrong with the unknowns, the synthetic truth and the recordings' overrides."""
    useless = list(_of_recordings(scene))
    removed = {item["loc"][1] for item in useless}  # nothing else that is wrong with these matters
    findings = [
        item for path, spec in scene.unknowns.items() if path not in removed for item in _unknown(scene, path, spec)
    ]
    return [*findings, *_duplicates(scene), *useless, *_truth(scene), *_overrides(scene)]


def _unknown(scene: Scene, path: str, unknown: Unknown) -> Iterator[InitErrorDetails]:
    place: Loc = ("unknowns", path)
    try:
        info = leaf(scene, path)
    except SceneError as error:
        yield finding(error.problems[0].message, place, kind=KEY)
        return
    if not info.differentiable:
        yield finding(_unreached(scene, path), place, kind=KEY)
        return
    followers = list(_followers(scene, path, unknown))
    yield from followers or _bounds(scene, path, unknown, info)
    yield from _per(scene, path, unknown)


def _unreached(scene: Scene, path: str) -> str:
    """Return why a number cannot be an unknown, and which can be."""
    recording, inside = split_own(path)
    head, prefix = inside.partition(".")[0], own_path(recording, "") if recording else ""
    if recording and head in FIXED:
        return f"all recordings share `{head}`: one recording can have its own bodies, loads, world ..."
    reached = [f"{prefix}{name}" for name in leaves(scene, differentiable=True) if not (prefix and _is_fixed(name))]
    return f"no gradient reaches it{suggest(path, reached)}; unknowns can be: {listed(reached)}"


def _is_fixed(path: str) -> bool:
    return path.partition(".")[0] in FIXED


def _followers(scene: Scene, path: str, unknown: Unknown) -> Iterator[InitErrorDetails]:
    """Yield findings for values that cannot be tied to an unknown."""
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
            yield finding(_unreached(scene, other), place, kind=KEY)
        elif split_own(path)[0] and not other.startswith("data."):
            message = "all recordings share it, so it cannot follow a value of one of them: make it the unknown"
            yield finding(message, place, kind=KEY)
        elif unknown.per != "body" and same[:1] + same[2:] != keys[:1] + keys[2:]:
            message = f"`per: {unknown.per}` can be tied to the same value of another body only"
            yield finding(message, place, kind=KEY)
        elif unknown.per != "body" and (message := _set_by_regions(scene, same)):
            yield finding(message, place, kind=KEY)


def _bounds(scene: Scene, path: str, unknown: Unknown, info: LeafInfo) -> Iterator[InitErrorDetails]:
    place: Loc = ("unknowns", path)
    for i, bound in enumerate(unknown.bounds):
        try:
            require_possible(scene, tied(scene, path, bound))
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
    if split_own(path)[0]:
        message = f"`per: {unknown.per}` is for values that all recordings share; use `per: body` for those of one"
        yield finding(message, place)
        return
    is_weight = keys[0] == "actuators" and keys[-1] == "weight"
    body = body_of(scene, ".".join(keys))
    if not is_weight and (keys[0] != "bodies" or keys[2] != "material"):
        how = "be a field" if unknown.per == "field" else f"differ by {unknown.per}"
        advice = "use `per: body`"
        if keys[0] == "actuators":
            weight = ".".join([*keys[:-1], "weight"])
            advice += f", or the unknown '{weight}', the share of the strength for each particle"
        yield finding(f"only a body's material, and an actuator's `weight`, can {how}; {advice}", place)
    elif unknown.per == "group" and not scene.bodies[body].group_names:
        yield finding(f"the body '{body}' has no groups; name some or use `per: body`", place)
    elif not is_weight and (message := _set_by_regions(scene, keys)):
        yield finding(message, place)


def _set_by_regions(scene: Scene, keys: Sequence[str]) -> str:
    """Return the problem if `material_of` sets a value that the unknown varies within the body; empty if not."""
    if keys[0] != "bodies" or keys[2:3] != ["material"]:
        return ""
    others = scene.bodies[keys[1]].material_of
    names = [name for name, other in others.items() if other.value(".".join(keys[3:])) is not None]
    return f"material_of sets a separate value for {listed(names)}: remove it, or use `per: body`" if names else ""


def _named(scene: Scene) -> list[tuple[Loc, str]]:
    """Return the place and the path of every unknown, and of every value tied to one."""
    named: list[tuple[Loc, str]] = [(("unknowns", path), path) for path in scene.unknowns]
    for path, unknown in scene.unknowns.items():
        named += [(("unknowns", path, "also", other), other) for other in unknown.also]
    return named


def _duplicates(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield findings for unknowns and tied values that are the same value, spelt differently."""
    first: dict[str, str] = {}
    for place, path in _named(scene):
        try:
            name = canonical(scene, path)
        except SceneError:
            continue  # there is no such path: reported above
        if name in first:
            yield finding(f"is the same value as the unknown '{first[name]}': name it once", place, kind=KEY)
        first.setdefault(name, path)


def _of_recordings(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield findings for unknown values of recordings that are held out, and unknown placements of what has none."""
    for name, recording in scene.recordings.items():
        begin = f"data.recordings.{name}."
        for place, path in _named(scene):
            if not path.startswith(begin):
                continue
            kind, what = path.removeprefix(begin).partition(".")[0], path.removeprefix(begin).removeprefix("overrides.")
            if recording.holdout:
                its = "its start" if what == "start" else f"its own value of {what}"
                message = f"the recording '{name}' is held out, so nothing determines {its}: remove this unknown"
                yield finding(message, place, kind=KEY)
            elif (kind in PLACED and kind not in recording.measurement.takes) or (
                what == "start" and recording.measurement.compares_rest
            ):
                message = f"has no meaning for the measurement `{recording.measurement.name}`: remove it"
                yield finding(message, place, kind=KEY)


def _truth(scene: Scene) -> Iterator[InitErrorDetails]:
    for path, value in (scene.synthetic.truth if scene.synthetic is not None else {}).items():
        place: Loc = ("data", "synthetic", "truth", path)
        try:
            info = leaf(scene, path)
        except SceneError as error:
            yield finding(error.problems[0].message, place, kind=KEY)
            continue
        if not info.differentiable or path.startswith("data."):
            yield finding(
                "only a value that can be an unknown can have a truth: set this one in the scene itself",
                place,
                kind=KEY,
            )
            continue
        try:
            with_values(scene, {info.path: value})
        except SceneError as error:
            yield finding(error.problems[0].message, place)


def _overrides(scene: Scene) -> Iterator[InitErrorDetails]:
    """Yield findings for overrides of recordings that the scene refuses, each tried alone, then all together."""
    for name, recording in scene.recordings.items():
        place: Loc = ("data", "recordings", name, "overrides")
        useless = list(_without_effect(scene, name, place))
        if useless:
            yield from useless
            continue
        refused = list(_refused(scene, place, {path: {path: v} for path, v in recording.overrides.items()}))
        yield from refused
        if len(recording.overrides) > 1 and not refused:
            yield from _refused(scene, place, {"": recording.overrides})


def _without_effect(scene: Scene, recording: str, place: Loc) -> Iterator[InitErrorDetails]:
    """Yield findings for overrides without effect: of shared sections, and of values that are fitted to all data."""
    named = {name: [name, *spec.also] for name, spec in scene.unknowns.items()}
    own = [split_own(path)[1] for _, path in _named(scene) if split_own(path)[0] == recording]
    for path in scene.recordings[recording].overrides:
        head = path.split(".")[0]
        shared = {name: [p for p in paths if not _is_one_of(scene, p, own)] for name, paths in named.items()}
        fitted = [(name, p) for name, paths in shared.items() for p in paths if _contains(scene, path, p)]
        if head in FIXED:
            message = f"all recordings share `{head}`: an override can change bodies, loads, the world ..."
            yield finding(message, (*place, path))
        elif fitted:
            name, number = fitted[0]
            message = (
                f"{'is fitted, as' if name == number else 'follows'} the unknown '{name}': a recording cannot have its "
                f"own value; to fit one for this recording alone, add the unknown '{own_path(recording, number)}'"
            )
            yield finding(message, (*place, path))


def _is_one_of(scene: Scene, path: str, others: Sequence[str]) -> bool:
    """Return whether a path and one of others are the same number, in any spelling."""
    return any(_contains(scene, path, other) and _contains(scene, other, path) for other in others)


def _contains(scene: Scene, path: str, name: str) -> bool:
    """Return whether a path is the same number as `name`, or a part of the scene that contains it, in any spelling."""
    try:
        full = canonical(scene, name)
    except SceneError:
        return False  # reported where it is named
    with contextlib.suppress(SceneError):  # the path may be a part of the scene
        path = canonical(scene, path)
    return any(other == path or other.startswith(f"{path}.") for other in (name, full))


def _refused(scene: Scene, place: Loc, trials: dict[str, dict[str, object]]) -> Iterator[InitErrorDetails]:
    for key, values in trials.items():
        try:
            with_values(scene, values)
        except SceneError as error:
            for problem in error.problems:
                message = problem.message if problem.path == key else f"{problem.path}: {problem.message}"
                yield finding(message, (*place, key) if key else place)

"""Check the names of regions: each is known where it is used, has one meaning, and is not defined by itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic_core import InitErrorDetails

from cqrun.explain import KEY, VALUE, Loc, finding, listed, suggest
from cqrun.geometry.region import Region
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Plugin, Spec
from cqrun.plugin.reference import Marked, NamesGroup, NamesRegion, body_of, marked_in
from cqrun.scene.sections import Sections
from cqrun.scene.walk import children, marked, parts


def unknown(kind: str, name: str, legal: list[str]) -> str:
    """Return the message about an unknown name."""
    return f"there is no {kind} '{name}'{suggest(name, legal)}; there are: {listed(legal)}"


def findings_of_regions(scene: Sections) -> list[InitErrorDetails]:
    """Return the problems with names of regions and groups, and with the regions of boundaries."""
    return [*_taken(scene), *_unknown(scene), *_circles(scene), *_of_boundaries(scene)]


def _taken(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield names that have two meanings."""
    for body, spec in scene.bodies.items():
        for name in spec.groups:
            if spec.group_names.count(name) > 1:
                message = f"is also a part or a colour of the body '{body}': rename one"
                yield finding(message, ("bodies", body, "groups", name), kind=KEY)
        for name in scene.regions:
            if name in spec.group_names:
                yield finding(f"is also a group of the body '{body}': rename one", ("regions", name), kind=KEY)


def _unknown(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield names that are unknown where they are used."""
    for region in marked(scene, NamesRegion):
        legal = _known_at(scene, region.loc)
        if region.value not in legal:
            yield _refusal(region, unknown("region", region.value, legal))
    for group in marked(scene, NamesGroup):
        of = group.mark.of
        body = _body_at(scene, group.loc) if of is None else getattr(group.part, of)
        legal = [*_groups_of(scene, body), *scene.regions]
        if group.value not in legal and (not body or body in scene.bodies):  # otherwise the body's name is reported
            kind = f"group of the body '{body}'" if body else "group"
            yield _refusal(group, unknown(kind, group.value, legal))


def _refusal(found: Marked[Any], message: str) -> InitErrorDetails:
    """Return the problem with a name; if the name stands for a plug-in, it is reported at the plug-in's choice."""
    part = found.part
    alone = isinstance(part, Plugin) and part.stands_alone and found.loc[-1] == part.shorthand
    return finding(message, found.loc[:-2] if alone else found.loc, kind=KEY if found.at_key else VALUE)


def _known_at(scene: Sections, loc: Loc) -> list[str]:
    """Return the names that a region may use at a place: all regions, and the groups of its body."""
    groups = () if loc[0] == "boundaries" else _groups_of(scene, _body_at(scene, loc))
    return list(dict.fromkeys([*scene.regions, *groups]))


def _groups_of(scene: Sections, body: str | None) -> list[str]:
    """Return the names of the groups of a body, or of all bodies if `body` names none."""
    bodies = [scene.bodies[body]] if body in scene.bodies else scene.bodies.values()
    return [name for spec in bodies for name in spec.group_names]


def _body_at(scene: Sections, loc: Loc) -> str:
    """Return the body whose particles a region selects; empty if it can be any body."""
    if loc[0] == "bodies":
        return str(loc[1])
    node: Any = scene
    body = ""
    for key in loc:
        node = children(node)[key]
        body = (body_of(node) if isinstance(node, Spec) else None) or body
    return body


def _names_in(region: Chosen[Any]) -> list[str]:
    return [found.value for found in marked(region, NamesRegion)]


def _circles(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield regions that are defined by themselves."""
    yield from _circles_among(scene.regions, scene.regions, ("regions",))
    for body, spec in scene.bodies.items():
        yield from _circles_among(spec.groups, {**scene.regions, **spec.groups}, ("bodies", body, "groups"))


def _circles_among(
    checked: Mapping[str, Chosen[Region]], known: Mapping[str, Chosen[Region]], place: Loc
) -> Iterator[InitErrorDetails]:
    for name in checked:
        reached: set[str] = set()
        waiting = _names_in(known[name])
        while waiting:
            inner = waiting.pop()
            if inner not in reached and inner in known:
                reached.add(inner)
                waiting += _names_in(known[inner])
        if name in reached:
            through = ", ".join(f"'{other}'" for other in sorted(reached - {name}))
            message = "is made of itself" + (f", through {through}" if through else "")
            yield finding(f"{message}: a region can only be made of others", (*place, name), kind=KEY)


def _of_boundaries(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield boundaries whose region selects particles, at any depth; a boundary acts on grid nodes."""
    for name, chosen in scene.boundaries.items():
        for found in marked_in(chosen.value, Choice):
            if isinstance(found.value.value, Region):
                yield from _of_particles(scene, found.value, ("boundaries", name, chosen.name, *found.loc))


def _of_particles(scene: Sections, region: Chosen[Region], loc: Loc) -> Iterator[InitErrorDetails]:
    """Yield the parts of a boundary's region, at any depth, that select particles; `loc` is the region's place."""
    seen: set[str] = set()
    waiting = [region]
    while waiting:
        current = waiting.pop()
        for _, part in parts(current):
            if isinstance(part, Region) and part.of_particles:
                message = f"must select grid nodes, but '{part.name}' selects particles: give a shape"
                yield finding(message, loc)
        for inner in set(_names_in(current)) - seen:
            seen.add(inner)
            if inner in scene.regions:
                waiting.append(scene.regions[inner])
            elif current is not region:  # if the boundary itself uses the name, `_unknown` reports it
                yield finding(f"must select grid nodes, but '{inner}' is a group of particles", loc)

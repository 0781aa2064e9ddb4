"""The names of regions: known where they are used, told apart, and never going round in circles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic_core import InitErrorDetails

from cqrun.explain import KEY, Loc, finding, listed, suggest
from cqrun.geometry.named import Named
from cqrun.geometry.region import Region
from cqrun.plugin.choice import Chosen
from cqrun.scene.sections import Sections
from cqrun.scene.walk import children, parts


def unknown(kind: str, name: str, legal: list[str]) -> str:
    """Return the message on a name that nothing has."""
    return f"there is no {kind} '{name}'{suggest(name, legal)}; there are: {listed(legal)}"


def findings_of_regions(scene: Sections) -> list[InitErrorDetails]:
    """Return what is wrong with the names of regions and groups, and with the regions of boundaries."""
    return [*_taken(scene), *_unknown(scene), *_circles(scene), *_of_boundaries(scene)]


def _taken(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield names that mean two things."""
    for body, spec in scene.bodies.items():
        for name in spec.groups:
            if spec.group_names.count(name) > 1:
                message = f"is a part or a colour of the body '{body}' as well: rename one"
                yield finding(message, ("bodies", body, "groups", name), kind=KEY)
        for name in scene.regions:
            if name in spec.group_names:
                yield finding(f"is a group of the body '{body}' as well: rename one", ("regions", name), kind=KEY)


def _unknown(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield names that nothing has where they are used."""
    for loc, part in parts(scene):
        if isinstance(part, Named):
            legal = _known_at(scene, loc)
            if part.region not in legal:
                yield finding(unknown("region", part.region, legal), loc[:-1])
    for body, spec in scene.bodies.items():
        legal = _known_at(scene, ("bodies", body))
        for name in spec.material_of:
            if name not in legal:
                yield finding(unknown("region", name, legal), ("bodies", body, "material_of", name), kind=KEY)


def _known_at(scene: Sections, loc: Loc) -> list[str]:
    """Return the names that a region may use at a place: of the regions, and of its body's groups."""
    if loc[0] == "boundaries":
        return list(scene.regions)
    body = _body_at(scene, loc)
    bodies = scene.bodies.values() if body not in scene.bodies else [scene.bodies[body]]
    return list(dict.fromkeys([*scene.regions, *(name for spec in bodies for name in spec.group_names)]))


def _body_at(scene: Sections, loc: Loc) -> str:
    """Return the body whose particles a region picks; empty where it may be any."""
    if loc[0] == "bodies":
        return str(loc[1])
    node: Any = scene
    body = ""
    for key in loc:
        node = children(node)[key]
        body = getattr(node, "body", None) or body
    return body


def _names_in(region: Chosen[Region]) -> list[str]:
    return [part.region for _, part in parts(region) if isinstance(part, Named)]


def _circles(scene: Sections) -> Iterator[InitErrorDetails]:
    """Yield regions that are made of themselves."""
    yield from _circles_among(scene.regions, scene.regions, ("regions",))
    for body, spec in scene.bodies.items():
        yield from _circles_among(spec.groups, {**scene.regions, **spec.groups}, ("bodies", body, "groups"))


def _circles_among(
    asked: Mapping[str, Chosen[Region]], known: Mapping[str, Chosen[Region]], place: Loc
) -> Iterator[InitErrorDetails]:
    for name in asked:
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
    """Yield boundaries whose region, or one that it names, is of particles: they hold nodes of the grid."""
    for name, chosen in scene.boundaries.items():
        region = getattr(chosen.value, "region", None)
        loc: Loc = ("boundaries", name, chosen.name, "region")
        seen: set[str] = set()
        waiting = [region] if region is not None else []
        while waiting:
            current = waiting.pop()
            for _, part in parts(current):
                if isinstance(part, Region) and part.of_particles:
                    message = f"is of nodes of the grid, and '{part.name}' picks particles: give a shape"
                    yield finding(message, loc)
            for inner in set(_names_in(current)) - seen:
                seen.add(inner)
                if inner in scene.regions:
                    waiting.append(scene.regions[inner])
                elif current is not region:  # told already where the boundary itself names it
                    yield finding(f"is of nodes of the grid, and '{inner}' is a group of particles", loc)

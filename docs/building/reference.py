"""Reference pages: one for each kind of plug-in, and one for the sections of a scene."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from docs.building.examples import example
from docs.building.words import docstring, escaped

KINDS = {
    "shape": ("Shapes", "A shape is where the particles of a body are at the start. Every shape is a region, too."),
    "region": ("Regions", "A region is a part of the world or of a body. Every shape is a region, too."),
    "sampling": ("Samplings", "A sampling places the particles of a body in its shape."),
    "elastic": ("Elastic laws", "The elastic law of a material."),
    "material_term": ("Further material terms", "What a material has besides its elastic law."),
    "actuator": ("Actuators", "What moves a robot. A controller or the section `activation` drives it."),
    "boundary": ("Boundaries", "What holds bodies, and what they touch."),
    "load": ("Loads", "Forces and masses from outside."),
    "force": ("Forces", "Forces that depend on the motion."),
    "controller": ("Controllers", "A controller turns what it observes into activations."),
    "observer": ("Observers", "What a controller sees."),
    "objective": ("Objectives", "A term of the loss, or of a constraint."),
    "measure": ("Measured quantities", "Numbers over time, named in the section `measure`."),
    "measurement": ("Measurements", "What a recording contains, and how the model is compared with it."),
    "optimizer": ("Optimizers", "What changes the unknowns and the controller."),
}
"""Title and first line of the page of each kind."""

PAGE_OF = re.compile(r" [(]cqrun describe ([a-z_\\]+)[)]")


def reference_pages() -> dict[str, str]:
    """Return the reference pages by their path in the site."""
    from cqrun.plugin.registry import FOLDERS

    pages = {f"reference/{kind}.md": "\n".join(_kind(kind)) for kind in FOLDERS}
    return {**pages, "reference/sections.md": "\n".join(_sections())}


def _kind(kind: str) -> Iterator[str]:
    from cqrun.plugin.registry import plugins

    title, first = KINDS[kind]
    yield from (f"(reference-{kind})=", f"# {title}", "", first, f"On the command line: `cqrun describe {kind}`.", "")
    own = {name: cls for name, cls in plugins(kind).items() if cls.kind == kind}
    others = [name for name, cls in plugins(kind).items() if cls.kind != kind]
    if others:
        links = ", ".join(f"[{name}](#{plugins(kind)[name].kind}-{name})" for name in others)
        yield from (f"Also {links}.", "")
    yield from ("| name | what it is |", "|---|---|")
    for name, cls in own.items():
        yield f"| [{name}](#{kind}-{name}) | {escaped(summary(cls))} |"
    yield ""
    for name, cls in own.items():
        yield from (f"({kind}-{name})=", f"## {name}", "", docstring(cls), "")
        yield from _example(kind, name)
        yield from _fields(cls)


def _link(command: re.Match[str]) -> str:
    """Return a link to the page that a command shows."""
    kind = command[1].replace("\\", "")
    return f" ([{KINDS[kind][0].lower()}](#reference-{kind}))"


def summary(cls: type) -> str:
    """Return the first sentence of a docstring."""
    return (cls.__doc__ or "").strip().partition("\n")[0]


def _example(kind: str, name: str) -> Iterator[str]:
    found = example(kind, name)
    if found:
        text, scene = found
        yield from (f"From `{scene}`:" if scene else "Example:", "", "```yaml", text.rstrip(), "```", "")


def _sections() -> Iterator[str]:
    from cqrun.cli.describe import _sections as sections_of_a_scene

    yield from ("# Sections of a scene", "", "On the command line: `cqrun describe scene`.", "")
    for name, cls in sections_of_a_scene().items():
        yield from (f"(section-{name})=", f"## {name}", "", docstring(cls), "")
        yield from _fields(cls, deepest=0)


def _fields(cls: Any, deepest: int = 9, outer: str = "") -> Iterator[str]:
    """Yield the fields of a part of a scene as definitions; the name of a nested field begins with the outer ones."""
    from cqrun.cli.describe import facts_of, parts_of

    for name in cls.model_fields:
        facts, text = facts_of(cls, name)
        yield f"`{outer}{name}`"
        yield f": {PAGE_OF.sub(_link, escaped(facts))}"
        if text:
            yield f"  <br>{escaped(text)}"
        yield ""
        for part in parts_of(cls, name) if deepest else ():
            yield from _fields(part, deepest - 1, f"{outer}{name}.")

"""Examples of plug-ins: the smallest use of each in a scene that a test loads."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
WIDTH = 90

OWN = Path(__file__).with_name("examples.yaml")

REGION = r"(?:.*\.)?(?:region|groups\.[^.]+|regions\.[^.]+|to_region)"
PLACES = {
    "shape": r"bodies\.[^.]+\.(?:shape|parts\.[^.]+)|.*\.(?:region|groups\.[^.]+)",
    "region": REGION,
    "sampling": r"bodies\.[^.]+\.sampling",
    "elastic": r"bodies\.[^.]+\.material\.elastic",
    "material_term": r"bodies\.[^.]+\.material",
    "actuator": r"actuators\.[^.]+",
    "boundary": r"boundaries\.[^.]+",
    "load": r"loads\.[^.]+",
    "force": r"forces\.[^.]+",
    "controller": r"controller",
    "observer": r"observers\.[^.]+",
    "objective": r"objective\.[^.]+|constraints\.[^.]+",
    "measure": r"measure\.[^.]+",
    "measurement": r"data\.recordings\.[^.]+",
    "optimizer": r"optimizer",
}
"""Where a plug-in of each kind is chosen in a scene: a pattern of key paths."""


def example(kind: str, name: str) -> tuple[str, str] | None:
    """Return the shortest example of a plug-in as YAML, and the path of the shipped scene that has it, or nothing."""
    found = []
    for scene, path, value in _uses():
        chosen = value.get("of", value) if kind == "objective" and path.startswith("constraints.") else value
        if isinstance(chosen, dict) and name in chosen and re.fullmatch(PLACES[kind], path):
            text = _as_yaml(path, {name: value[name]} if chosen is value else value)
            found.append((not scene.startswith("scenes/"), len(text), text, scene))
    if not found:
        return None
    other, _, text, scene = min(found)
    return text, "" if other else scene


@cache
def _uses() -> list[tuple[str, str, Any]]:
    """Return scene, key path and value of every mapping in the shipped scenes, the fuzzer's, and examples.yaml."""
    uses = []
    for path in sorted([*(ROOT / "scenes").rglob("*.yaml"), *(ROOT / "tests/fuzz/scenes").glob("*.yaml"), OWN]):
        for scene in yaml.safe_load_all(path.read_text("utf-8")):
            uses += [(path.relative_to(ROOT).as_posix(), *place) for place in _walk(with_on(scene), "")]
    return uses


def with_on(value: Any) -> Any:
    """Return a part of a scene with the key `on`, which PyYAML reads as true."""
    if isinstance(value, list):
        return [with_on(inner) for inner in value]
    if isinstance(value, dict):
        return {"on" if key is True else key: with_on(inner) for key, inner in value.items()}
    return value


def _walk(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        yield path, value
        for key, inner in value.items():
            yield from _walk(inner, f"{path}.{key}" if path else str(key))


def _as_yaml(path: str, value: dict[str, Any]) -> str:
    """Return a value at a key path as YAML: a line for each key of the path, and the value in flow style."""
    keys = path.split(".")
    lines = [f"{'  ' * depth}{key}:" for depth, key in enumerate(keys)]
    short = f"{lines[-1]} {_flow(value)}"
    if len(short) <= WIDTH:
        return "\n".join([*lines[:-1], short]) + "\n"
    return "\n".join([*lines, *_block(value, "  " * len(keys))]) + "\n"


def _block(value: dict[str, Any], indent: str) -> Iterator[str]:
    """Yield the lines of a mapping: each entry in flow style if it is short, and as a block otherwise."""
    for key, inner in value.items():
        flow = f"{indent}{key}: {_flow(inner)}"
        if len(flow) <= WIDTH or not isinstance(inner, dict):
            yield flow
        else:
            yield f"{indent}{key}:"
            yield from _block(inner, indent + "  ")


def _flow(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000).partition("\n")[0]

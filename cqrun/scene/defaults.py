"""Defaults that depend on other parts of the scene: zero vectors, the only body."""

from __future__ import annotations

from typing import Any

FILLED = {
    "World": {"gravity"},
    "Body": {"velocity", "spin"},
    "Recording": {"body"},
    "Synthetic": {"body"},
}
"""Fields, by model, that a user may leave out although the model has no default of its own."""


def with_defaults(scene: Any) -> Any:
    """Return plain scene data with these defaults filled in; anything unexpected is left to the schema."""
    if not isinstance(scene, dict):
        return scene
    world, bodies = _mapping(scene.get("world")), _mapping(scene.get("bodies"))
    size = world.get("size")
    dim = len(size) if isinstance(size, list) and len(size) in (2, 3) else 3
    zero = {"velocity": [0.0] * dim, "spin": [0.0] * (1 if dim == 2 else 3)}
    changes: dict[str, Any] = {}
    if world:
        changes["world"] = _filled(world, {"gravity": [0.0] * dim})
    if bodies:
        changes["bodies"] = {name: _filled(body, zero) for name, body in bodies.items()}
    if _mapping(scene.get("data")):
        changes["data"] = _data(scene["data"], bodies)
    return {**scene, **changes}


def _data(data: dict[str, Any], bodies: dict[str, Any]) -> dict[str, Any]:
    body = {"body": next(iter(bodies))} if len(bodies) == 1 else {}
    changes: dict[str, Any] = {}
    if _mapping(data.get("recordings")):
        changes["recordings"] = {name: _filled(rec, body) for name, rec in data["recordings"].items()}
    if "target" in data:  # is refused: for what is to be written in its place
        changes["target"] = _filled(data["target"], body)
    if "synthetic" in data:
        changes["synthetic"] = _filled(data["synthetic"], body)
    return {**data, **changes}


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _filled(part: Any, defaults: dict[str, Any]) -> Any:
    return {**part, **{k: v for k, v in defaults.items() if k not in part}} if isinstance(part, dict) else part

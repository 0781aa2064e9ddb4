"""Walk through a scene: every part with its place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cqrun.explain import Loc
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Spec


def children(node: Any) -> dict[int | str, Any]:
    """Return what a node of a scene holds, by the key that a path uses for it."""
    if isinstance(node, Spec):
        found: dict[int | str, Any] = {name: getattr(node, name) for name in type(node).model_fields}
        return found | dict(node.model_extra or {})
    if isinstance(node, Chosen):
        return {node.name: node.value}
    if isinstance(node, dict):
        return dict(node)
    if isinstance(node, list):
        return dict(enumerate(node))
    return {}


def parts(node: Any, loc: Loc = ()) -> Iterator[tuple[Loc, Spec]]:
    """Yield every part (a `Spec`) at and below a node, with its place."""
    if isinstance(node, Spec):
        yield loc, node
    for key, child in children(node).items():
        yield from parts(child, (*loc, key))

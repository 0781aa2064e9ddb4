"""Walk through a scene: yield its parts and marked values, each with its place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

from cqrun.explain import Loc
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Spec
from cqrun.plugin.reference import Marked, marked_in

M = TypeVar("M")


def children(node: Any) -> dict[int | str, Any]:
    """Return the children of a node of a scene, by the key that a path uses for each."""
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
    """Yield (place, part) for every part (a `Spec`) at and below a node."""
    if isinstance(node, Spec):
        yield loc, node
    for key, child in children(node).items():
        if isinstance(child, (Spec, Chosen, dict, list)):
            yield from parts(child, (*loc, key))


def marked(node: Any, kind: type[M]) -> Iterator[Marked[M]]:
    """Yield every value at and below a node whose type has a mark of class `kind`, with its place."""
    for loc, part in parts(node):
        for found in marked_in(part, kind):
            yield found.below(loc)

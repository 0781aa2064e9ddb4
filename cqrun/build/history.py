"""The fields that materials with history add to the state."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cqrun.errors import Problem, SceneError
from cqrun.scene.schema import Scene
from cqrun.state import StateField


def fields_of(spec: Any, dim: int) -> tuple[StateField, ...]:
    """Return the fields of one material term, under the names that they have in the state: `prony.Q_1`."""
    return tuple(field._replace(name=f"{spec.name}.{field.name}") for field in spec.history(dim))


def remembering(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield the key path and the name of every material term whose history never fades, so that it has no rest."""
    for body, spec in scene.bodies.items():
        elastic = spec.material.elastic
        own = {f"elastic.{elastic.name}": elastic.value, **spec.material.terms}
        for key, term in own.items():
            if fields_of(term, scene.dim) and not term.relaxes:  # type: ignore[attr-defined]  # a term, by its kind
                yield f"bodies.{body}.material.{key}", term.name


def history_of(scene: Scene) -> tuple[StateField, ...]:
    """Return the fields of all materials of a scene; bodies whose terms name the same field share its rows.

    Raises:
        SceneError: a term declares a field in two shapes.
    """
    found: dict[str, StateField] = {}
    for body, spec in scene.bodies.items():
        for term in (spec.material.elastic.value, *spec.material.terms.values()):
            for field in fields_of(term, scene.dim):
                if found.setdefault(field.name, field) != field:
                    path = f"bodies.{body}.material"
                    message = (
                        f"the history '{field.name}' has the shape {field.shape} here and {found[field.name].shape} in "
                        "another body: give all bodies the same settings, or a term whose names tell its shapes apart"
                    )
                    raise SceneError([Problem(scene.where(path), path, message)])
    return tuple(found.values())

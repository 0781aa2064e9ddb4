"""Bind the measured quantities of a scene to its particles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cqrun.build.matter import matter_of
from cqrun.build.model import Built
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.measures.measure import BoundMeasure
from cqrun.plugin.contract import Array


def bound_measures(built: Built, values: Mapping[str, Array] | None = None) -> dict[str, BoundMeasure]:
    """Return the measured quantities of a scene by name, bound to its particles with values by path.

    Raises:
        SceneError: one of them does not fit the scene.
    """
    if not built.scene.measure:
        return {}
    matter, found = matter_of(built, dict(values or {})), {}
    for name, chosen in built.scene.measure.items():
        spec: Any = chosen.value
        try:
            found[name] = spec.bind(matter)
        except UsageError as error:
            path = f"measure.{name}.{chosen.name}"
            raise SceneError([Problem(built.scene.where(path), path, str(error))]) from error
    return found

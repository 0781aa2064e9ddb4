"""The boundaries whose force and moment in motion are recorded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cqrun.scene.schema import Scene


def boundaries_by_user(scene: Scene) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each term and each recording that needs boundaries: its key path, and their names."""
    users: dict[str, Any] = {f"objective.{name}.{c.name}": c.value for name, c in scene.objective.items()}
    users |= {f"constraints.{name}.of.{c.of.name}": c.of.value for name, c in scene.constraints.items()}
    for name, recording in scene.recordings.items():
        users[f"data.recordings.{name}.{recording.measurement.name}"] = recording.measurement
    for path, user in users.items():
        if user.boundaries:
            yield path, user.boundaries


def needed_boundaries(scene: Scene) -> tuple[str, ...]:
    """Return the boundaries that terms and recordings need, in the order of the scene."""
    needed = {name for _, names in boundaries_by_user(scene) for name in names}
    return tuple(name for name in scene.boundaries if name in needed)

"""What observers and objectives may know of a scene: particles at rest, their names, and time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.plugin.contract import Array

A_GROUP = "Group of the body, or region of the scene, by name; the whole body if absent"
"""What a field `group` of observers and objectives takes."""


def _none_recorded(file: str, units: str | None, marker: str) -> tuple[Array, Array]:
    """Stand for the recordings of a scene that has none."""
    raise UsageError(f"{file}: no recordings can be read here")


@dataclass(frozen=True)
class Matter:
    """A scene's particles, before it runs.

    Attributes:
        x: (N, D) positions at rest [m].
        mass: (N,) [kg].
        size: (D,) edge lengths of the world [m].
        control_step: time between two observations [s].
        n_controls: control steps T in a run.
        bodies: each body's slice of the particles.
        spacing: distance between the particles of each body [m].
        groups: body -> group -> indices of its particles.
        regions: names of the scene's regions, which serve as groups of every body.
        select: (body or None, region or None) -> indices of the particles there.
        goals: goal -> number of its entries.
        n_actuators: A.
        neutral: (A,) activations that do nothing, or as little as they may.
        resolve: a file as named in the scene -> where it is.
        recorded: (file as named in the scene, its units or None, marker) -> times (T,) at which the marker was seen
            [s], and where (T, D) [m]; UsageError where there is no such file or marker.
        design: (Q, N) what `objectives/design.py` lists of every particle, where the unknowns start; none if empty.
    """

    x: Array
    mass: Array
    size: Array
    control_step: float
    n_controls: int
    bodies: dict[str, slice]
    groups: dict[str, dict[str, Array]]
    select: Callable[[str | None, Any], Array]
    goals: dict[str, int]
    n_actuators: int
    resolve: Callable[[str], Path] = Path
    recorded: Callable[[str, str | None, str], tuple[Array, Array]] = _none_recorded
    design: Array = field(default_factory=lambda: np.zeros((0, 0)))
    regions: Sequence[str] = ()
    neutral: Array = field(default_factory=lambda: np.zeros(0))
    spacing: Mapping[str, float] = field(default_factory=dict)

    @property
    def n_particles(self) -> int:
        """Number of particles N."""
        return len(self.x)

    @property
    def dim(self) -> int:
        """Dimension of the world D."""
        return len(self.size)

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return self.n_controls * self.control_step

    def members(self, body: str, group: str | None = None) -> Array:
        """Return the indices of a body's particles, or of one of its groups.

        Raises:
            UsageError: there is no such body or group, or it holds no particle.
        """
        if body not in self.bodies:
            raise UsageError(_unknown("body", body, self.bodies))
        return _held(self.select(body, None) if group is None else self._group(body, group), body, group)

    def within(self, body: str | None, region: Any) -> Array:
        """Return the indices of the particles of a body (or of all) in a region (or anywhere).

        Raises:
            UsageError: there is no such body, or no particle there.
        """
        if body is not None and body not in self.bodies:
            raise UsageError(_unknown("body", body, self.bodies))
        return _held(self.select(body, region), body, None if region is None else "this region")

    def goal_size(self, goal: str) -> int:
        """Return how many entries a goal has; UsageError where there is none of this name."""
        if goal not in self.goals:
            raise UsageError(_unknown("goal", goal, self.goals))
        return self.goals[goal]

    def _group(self, body: str, group: str) -> Array:
        known = self.groups.get(body, {})
        if group not in known and group in self.regions:
            return self.select(body, group)
        if group not in known:
            raise UsageError(_unknown(f"group of the body '{body}'", group, [*known, *self.regions]))
        return known[group]


B = TypeVar("B", covariant=True)


class Bindable(Protocol[B]):
    """A plug-in that is bound to a scene's particles."""

    def bind(self, matter: Matter) -> B:
        """Return it over the particles; UsageError where it does not fit them."""


class Unfit(UsageError):
    """A plug-in that does not fit the scene; `name` is what the scene calls it."""

    def __init__(self, name: str, message: str) -> None:
        super().__init__(message)
        self.name = name


def bind_each(specs: Mapping[str, Bindable[B]], matter: Matter) -> dict[str, B]:
    """Return plug-ins over a scene's particles, by name.

    Raises:
        Unfit: one does not fit the scene.
    """
    bound = {}
    for name, spec in specs.items():
        try:
            bound[name] = spec.bind(matter)
        except UsageError as error:
            raise Unfit(name, str(error)) from error
    return bound


def _held(indices: Array, body: str | None, place: str | None) -> Array:
    if len(indices) == 0:
        where = " of ".join(part for part in (place, f"the body '{body}'" if body else None) if part) or "the scene"
        raise UsageError(f"{where} holds no particle: enlarge it, or name another")
    return indices


def _unknown(kind: str, name: str, legal: Any) -> str:
    return f"there is no {kind} called '{name}'{suggest(name, legal)}; there are: {listed(legal)}"

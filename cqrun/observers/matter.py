"""The view of a scene for observers and objectives: particles at rest, names of bodies and groups, and time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.forces.route import Pulling
from cqrun.plugin.contract import Array

A_GROUP = "Group of the body, or region of the scene, by name; the whole body if absent"
"""Description of a field `group` of observers and objectives."""


def _no_recordings(file: str, units: str | None, marker: str) -> tuple[Array, Array]:
    """Raise UsageError: the default of `Matter.recorded`, for scenes without recordings."""
    raise UsageError(f"{file}: no recordings can be read here")


B = TypeVar("B", covariant=True)


class Bindable(Protocol[B]):
    """A plug-in that can be bound to a scene's particles."""

    def bind(self, matter: Matter) -> B:
        """Bind the plug-in to the particles; UsageError if it does not fit them."""


@dataclass(frozen=True)
class Route:
    """A cable or a spring, or one of several cables on a spool.

    Attributes:
        particles: the particles that its points ride on, in order; -1 for a point that is fixed in the world.
        number: its number among all parts of actuators and forces.
        law: the plug-in, which knows the tension.
        activated: whether it has an activation.
        offsets: of its points from the particles at rest (n, D) [m], or the place of one that is fixed; None for the
            particles themselves.
        rest: its points at rest (n, D) [m]; None if they are not known.
        begin, turn: its law has the activation begin + turn u, for the activation u of the spool.
    """

    particles: Array
    number: int
    law: Pulling
    activated: bool
    offsets: Array | None = None
    rest: Array | None = None
    begin: float = 0.0
    turn: float = 1.0


@dataclass(frozen=True)
class Wall:
    """The wall of a chamber.

    Attributes:
        particles: the particle that each of its points rides on (n,).
        offsets: of the points at rest from their particles (n, D) [m].
        facets: (T, D) the points of each facet, with normals out of the chamber.
        number: of the chamber among all parts of actuators and forces.
        law: the plug-in, which knows the pressure.
        begin, turn: as those of a `Route`.
    """

    particles: Array
    offsets: Array
    facets: Array
    number: int
    law: Any
    begin: float = 0.0
    turn: float = 1.0


@dataclass(frozen=True)
class ActuatorPart:
    """A part of an actuator, with an activation of its own.

    Attributes:
        name: of the part; that of the actuator if it has only one.
        actuator: name of the actuator.
        number: its number among all parts.
        law: the plug-in.
        particles: (n,) indices of its particles.
        constants: its other numbers (`Actuator.constants`).
        weights: where its particles are among the weights of all parts.
    """

    name: str
    actuator: str
    number: int
    law: Any
    particles: Array
    constants: Array
    weights: slice


@dataclass(frozen=True)
class Material:
    """Where the parameters of a body's material are among all (`Track.terms`), and what its terms are.

    Attributes:
        group: number of the group of bodies with the same terms.
        begin: the first particle of the group.
        makers: return each term's kernel view from its parameters (rows, n).
    """

    group: int
    begin: int
    makers: Sequence[Callable[[Array], Any]]


@dataclass(frozen=True)
class Corners:
    """The corners of cells, over which volumes are averaged (engine/reference/volume.py).

    Attributes:
        hats: positions at rest (N, D) [m] -> weights of all M corners at the particles (M, N), sparse.
        slopes: the same -> derivatives of these weights by the position along each axis [1/m], D of (M, N).
    """

    hats: Callable[[Array], Any]
    slopes: Callable[[Array], Sequence[Any]]


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
        regions: names of the scene's regions; each can be used as a group of every body.
        select: (body or None, region or None) -> indices of the particles there.
        goals: goal -> number of its entries.
        n_actuators: number of actuators A.
        neutral: (A,) activation of each actuator that does nothing, or as little as its range allows.
        recorded: (file name in the scene, its units or None, marker) -> times (T,) at which the marker was seen [s],
            and its positions then (T, D) [m]; UsageError if there is no such file or marker.
        n_parts: number of parts of actuators and forces.
        strength, rest_length: of every part, as in `Track`, at the initial values of the unknowns; empty if not known.
        parts: of all actuators, in order.
        routes: name -> cable or spring; those on a spool after the first are called NAME.1, NAME.2 and so on.
        walls: name -> wall of a chamber.
        materials: body -> its material.
        terms: parameters of all terms of the stress at the initial values of the unknowns, as in `Track.terms`.
        corners: the corners of cells, if volumes are averaged over them.
        room: (N,) space that each particle fills, divided by its volume in the engine: 1, if not of unit mass.
        measures: name -> measured quantity of the scene, which is not bound yet.
        design: (Q, N) rows of `objectives/design.py` at the initial values of the unknowns; (0, 0) if not known.
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
    recorded: Callable[[str, str | None, str], tuple[Array, Array]] = _no_recordings
    design: Array = field(default_factory=lambda: np.zeros((0, 0)))
    regions: Sequence[str] = ()
    neutral: Array = field(default_factory=lambda: np.zeros(0))
    spacing: Mapping[str, float] = field(default_factory=dict)
    n_parts: int = 0
    strength: Array = field(default_factory=lambda: np.zeros(0))
    rest_length: Array = field(default_factory=lambda: np.zeros(0))
    parts: Sequence[ActuatorPart] = ()
    routes: Mapping[str, Route] = field(default_factory=dict)
    walls: Mapping[str, Wall] = field(default_factory=dict)
    materials: Mapping[str, Material] = field(default_factory=dict)
    terms: Sequence[Sequence[Array]] = ()
    corners: Corners | None = None
    room: Array = field(default_factory=lambda: np.zeros(0))
    measures: Mapping[str, Bindable[Any]] = field(default_factory=dict)

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
            UsageError: there is no such body or group, or it contains no particle.
        """
        if body not in self.bodies:
            raise UsageError(_unknown("body", body, self.bodies))
        return _not_empty(self.select(body, None) if group is None else self._group(body, group), body, group)

    def within(self, body: str | None, region: Any) -> Array:
        """Return the indices of the particles of a body (or of all) in a region (or anywhere).

        Raises:
            UsageError: there is no such body, or it has no particle there.
        """
        if body is not None and body not in self.bodies:
            raise UsageError(_unknown("body", body, self.bodies))
        return _not_empty(self.select(body, region), body, None if region is None else "this region")

    def goal_size(self, goal: str) -> int:
        """Return how many entries a goal has; UsageError if there is no goal of this name."""
        if goal not in self.goals:
            raise UsageError(_unknown("goal", goal, self.goals))
        return self.goals[goal]

    def measured(self, name: str) -> Any:
        """Return a measured quantity of the scene, bound to these particles; UsageError if there is none."""
        if name not in self.measures:
            raise UsageError(_unknown("measured quantity", name, self.measures))
        return self.measures[name].bind(self)

    def _group(self, body: str, group: str) -> Array:
        known = self.groups.get(body, {})
        if group not in known and group in self.regions:
            return self.select(body, group)
        if group not in known:
            raise UsageError(_unknown(f"group of the body '{body}'", group, [*known, *self.regions]))
        return known[group]


class Unfit(UsageError):
    """Raised for a plug-in that does not fit the scene; `name` is its name in the scene."""

    def __init__(self, name: str, message: str) -> None:
        super().__init__(message)
        self.name = name


def bind_each(specs: Mapping[str, Bindable[B]], matter: Matter) -> dict[str, B]:
    """Bind plug-ins to a scene's particles, and return them by name.

    Raises:
        Unfit: a plug-in does not fit the scene.
    """
    bound = {}
    for name, spec in specs.items():
        try:
            bound[name] = spec.bind(matter)
        except UsageError as error:
            raise Unfit(name, str(error)) from error
    return bound


def _not_empty(indices: Array, body: str | None, place: str | None) -> Array:
    if len(indices) == 0:
        where = " of ".join(part for part in (place, f"the body '{body}'" if body else None) if part) or "the scene"
        raise UsageError(f"{where} holds no particle: enlarge it, or name another")
    return indices


def _unknown(kind: str, name: str, legal: Any) -> str:
    return f"there is no {kind} called '{name}'{suggest(name, legal)}; there are: {listed(legal)}"

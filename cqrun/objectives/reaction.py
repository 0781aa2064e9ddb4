"""Reactions: the force or the moment with which a boundary acts on the bodies."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import Loc, complaint, finding
from cqrun.objectives.axes import AXES, Axis
from cqrun.objectives.gaps import lengths, lengths_vjp
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import BoundaryName
from cqrun.plugin.registry import plugin

Point = Annotated[list[float], Field(min_length=2, max_length=2)]


def wrong_axis(component: str | None, of: Literal["force", "moment"], dim: int) -> list[tuple[Loc, str]]:
    """Return what is wrong with a component of a reaction in a world of `dim` dimensions."""
    if dim == 3 or component is None:
        return []
    if of == "moment":
        return [] if component == "z" else [(("component",), "a moment in a 2D world is about z")]
    return [(("component",), "a 2D world has no axis z")] if component == "z" else []


def place_of(component: str, of: Literal["force", "moment"], dim: int) -> int:
    """Return the place of a component among the D forces and the moments that follow them."""
    if of == "force":
        return AXES.index(component)
    return 2 if dim == 2 else 3 + AXES.index(component)


class OfBoundary(ObjectiveTerm):
    """Base of terms of a boundary's force or moment."""

    boundary: BoundaryName = Field(description="Boundary whose force or moment it is")
    of: Literal["force", "moment"] = Field(
        description="A moment is about the centre of the material inside a `sticky` or `slip` boundary at rest, or the "
        "clamp's `center`, and about the origin of the world for a boundary that bodies touch",
        default="force",
    )
    on: Literal["body", "boundary"] = Field(
        description="On what it acts: on the bodies, or on the boundary, as a load cell behind it shows", default="body"
    )

    @property
    def boundaries(self) -> tuple[str, ...]:
        """The boundary whose reactions it needs."""
        return (self.boundary,)

    @property
    def sign(self) -> float:
        """1 for what acts on the bodies, -1 for what acts on the boundary."""
        return 1.0 if self.on == "body" else -1.0


@plugin("objective", "reaction")
class Reaction(OfBoundary):
    """Force [N] or moment [N m] of a boundary: a component, or the magnitude. 2D: [N/m], [N].

    It is the mean over each control step of what the boundary does to the bodies, in the reference frame: of clamps,
    also those that move, and of floors and obstacles with their friction. Its peak is `over: maximum`.
    """

    component: Axis | None = Field(description="Axis of the world; the magnitude if absent", default=None)

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [*super().dim_problems(dim), *wrong_axis(self.component, self.of, dim)]

    def bind(self, matter: Matter) -> BoundTerm:
        return BoundReaction(self, matter)


class BoundReaction(BoundTerm):
    """A component of a boundary's reaction, or its magnitude."""

    def __init__(self, spec: Reaction, matter: Matter) -> None:
        self.rows, self.over = means([], matter.n_particles), spec.over
        self.boundary, self.sign = spec.boundary, spec.sign
        dim, is_force = matter.dim, spec.of == "force"
        self.magnitude = spec.component is None
        self.columns = slice(0, dim) if is_force else slice(dim, None)
        if spec.component is not None:
            k = place_of(spec.component, spec.of, dim)
            self.columns = slice(k, k + 1)

    def steps(self, track: Track) -> Array:
        rows = self._rows(track)
        return lengths(rows, squared=False) if self.magnitude else self.sign * rows[:, 0]

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        rows, held_bar = self._rows(track), np.zeros(track.held[self.boundary].shape)
        by_row = lengths_vjp(rows, False, h_bar) if self.magnitude else self.sign * h_bar[:, None]
        held_bar[1:, self.columns] = by_row
        return TrackBar(held={self.boundary: held_bar})

    def _rows(self, track: Track) -> Array:
        """Return the components that count, at the end of every control step (T, 1 to 3)."""
        return track.held[self.boundary][1:, self.columns]


@plugin("objective", "reaction_track")
class ReactionTrack(OfBoundary):
    """Squared difference [N^2] of a component of a boundary's force or moment from a course over time.

    The course is interpolated linearly between its points, and constant before the first and after the last. A mean
    over a control step is compared with the course in the middle of that step.
    """

    least: ClassVar[float] = 0.0

    component: Axis = Field(description="Axis of the world; a moment in 2D is about z")
    path: list[Point] = quantity("s, N", "Points [t, force or moment] of the course", min_length=1)
    over: Over = Field(description="How the values of all control steps are combined", default="mean")

    @model_validator(mode="after")
    def _times_increase(self) -> Self:
        times = np.array([point[0] for point in self.path])
        if np.any(np.diff(times) <= 0) or np.any(times < 0):
            message = "must have times that begin at 0 or later and increase from point to point"
            raise complaint("ReactionTrack", [finding(message, ("path",))])
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [*super().dim_problems(dim), *wrong_axis(self.component, self.of, dim)]

    def bind(self, matter: Matter) -> BoundTerm:
        return BoundReactionTrack(self, matter)


class BoundReactionTrack(BoundTerm):
    """The squared difference from the course."""

    def __init__(self, spec: ReactionTrack, matter: Matter) -> None:
        self.rows, self.over = means([], matter.n_particles), spec.over
        self.boundary, self.sign = spec.boundary, spec.sign
        self.column = place_of(spec.component, spec.of, matter.dim)
        middles = (np.arange(matter.n_controls) + 0.5) * matter.control_step
        times, values = np.array(spec.path).T
        self.wanted = np.interp(middles, times, values)

    def steps(self, track: Track) -> Array:
        return self._gap(track) ** 2

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        held_bar = np.zeros(track.held[self.boundary].shape)
        held_bar[1:, self.column] = 2.0 * self.sign * self._gap(track) * h_bar
        return TrackBar(held={self.boundary: held_bar})

    def _gap(self, track: Track) -> Array:
        return np.asarray(self.sign * track.held[self.boundary][1:, self.column] - self.wanted)

"""Base of the terms of an objective: a term computes one number from a run, which should be small or large.

A term gives a value h_t at the end of every control step, t = 1 .. T. The start has no value, as no controller can
change it. `over` combines these values: `final` is h_T; `mean`; `sum` is the integral, the sum of h_t times the
control step; `product`; `minimum` and `maximum`, whose gradient goes to the first step that attains them. The loss is
the sum over terms of sense * weight * value, so a term that should be large is counted negative.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.observers.matter import Matter, bind_each
from cqrun.observers.rows import slices, stacked
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, Plugin

if TYPE_CHECKING:
    from scipy.sparse import csr_array

MOST_PLACES = 200
"""Largest number of positions of a course in a trajectory file, because HDF5 attributes are limited to 64 KiB."""

Over = Literal["final", "mean", "sum", "minimum", "maximum", "product"]


class BoundTerm(ABC):
    """A term bound to one scene's particles.

    Attributes:
        rows: (K, N) weights of the sums over particles that it needs.
        over: how the values of the control steps are combined.
        course: (K, D) positions that a body should pass one after the other [m], for pictures; None if it has none.
    """

    rows: csr_array
    over: Over
    course: Array | None = None

    @abstractmethod
    def steps(self, track: Track) -> Array:
        """Return the value at the end of every control step (T,), or at the term's own times."""

    @abstractmethod
    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        """Return the cotangent of the track from that of `steps`."""

    def value(self, track: Track) -> float:
        """Return the term's value, in its own unit."""
        return reduced(self.steps(track), self.over, track.control_step)

    def value_vjp(self, track: Track, bar: float) -> TrackBar:
        """Return the cotangent of the track from that of the value."""
        return self.steps_vjp(track, reduced_vjp(self.steps(track), self.over, track.control_step, bar))


class ObjectiveTerm(Plugin):
    """Base of the plug-ins of kind `objective`. `sense` is -1 if larger is better; `least` is the lowest value."""

    sense: ClassVar[Literal[1, -1]] = 1
    least: ClassVar[float] = -np.inf

    weight: float = Field(description="Factor in the loss", default=1.0)
    over: Over = Field(description="How the values of all control steps are combined", default="final")

    @property
    def boundaries(self) -> tuple[str, ...]:
        """The boundaries whose force and moment it needs, which only the reference frame has."""
        return ()

    @abstractmethod
    def bind(self, matter: Matter) -> BoundTerm:
        """Bind this term to a scene's particles.

        Raises:
            UsageError: a name or a number of particles does not fit the scene.
        """

    def likely_mistakes(self, neutral: Mapping[str, float]) -> Iterator[tuple[str, str]]:
        """Yield likely mistakes: the name of the field, and what is wrong with it.

        Args:
            neutral: actuator -> the activation at which it does nothing.
        """
        yield from ()


class Objective:
    """A weighted sum of terms; `Unfit` if a term does not fit the scene."""

    def __init__(self, terms: Mapping[str, ObjectiveTerm], matter: Matter) -> None:
        self.terms = bind_each(terms, matter)
        self.factors = {name: term.sense * term.weight for name, term in terms.items()}
        bound = list(self.terms.values())
        self.rows = stacked([term.rows for term in bound], matter.n_particles)
        self._places = dict(zip(self.terms, slices([term.rows.shape[0] for term in bound]), strict=True))

    def values(self, track: Track) -> dict[str, float]:
        """Return each term's value by name, in its own unit, without weight."""
        return {name: term.value(track.part(self._places[name])) for name, term in self.terms.items()}

    def loss(self, track: Track) -> float:
        """Return the sum over terms of sense * weight * value."""
        return self.weighted_sum(self.values(track))

    def weighted_sum(self, values: Mapping[str, float]) -> float:
        """Return the loss for given values of the terms."""
        return sum(self.factors[name] * value for name, value in values.items())

    def wanted(self, goals: Mapping[str, Array]) -> dict[str, Any]:
        """Return the target positions for a trajectory file [m]: goals, and courses of up to MOST_PLACES positions."""
        targets: dict[str, Any] = {"goals": {name: goal.tolist() for name, goal in goals.items()}}
        courses = {name: term.course for name, term in self.terms.items() if term.course is not None}
        if courses:
            targets["courses"] = {
                name: course[:: -(-len(course) // MOST_PLACES)].tolist() for name, course in courses.items()
            }
        return targets

    def loss_vjp(self, track: Track, bar: float = 1.0) -> TrackBar:
        """Return the cotangent of the track from that of the loss."""
        return self.values_vjp(track, {name: bar * factor for name, factor in self.factors.items()})

    def values_vjp(self, track: Track, bars: Mapping[str, float]) -> TrackBar:
        """Return the cotangent of the track from those of some of the terms' values."""
        total = TrackBar()
        for name, bar in bars.items():
            term_bar = self.terms[name].value_vjp(track.part(self._places[name]), bar)
            for part in ("x", "v", "C", "F"):
                _add(total, part, getattr(term_bar, part), getattr(track, part), (slice(None), self._places[name]))
            _add(total, "activation", term_bar.activation, track.activation, ())
            total.add_inputs_of(term_bar)
            for part, bars_by_name in term_bar.by_name.items():
                for key, more in bars_by_name.items():
                    so_far = getattr(total, part) or {}
                    setattr(total, part, {**so_far, key: so_far.get(key, 0.0) + more})
        return total


def _add(total: TrackBar, name: str, bar: Array | None, like: Array, place: Any) -> None:
    if bar is None:
        return
    if getattr(total, name) is None:
        setattr(total, name, np.zeros(like.shape))
    getattr(total, name)[place] += bar


def reduced(h: Array, over: Over, control_step: float) -> float:
    """Return the values h (T,) of the steps combined into one number."""
    if over == "final":
        return h[-1]
    if over == "mean":
        return h.mean()
    if over == "sum":
        return control_step * h.sum()
    if over == "product":
        return np.prod(h)
    return h[_extremal(h, over)]


def reduced_vjp(h: Array, over: Over, control_step: float, bar: float) -> Array:
    """Return the cotangent of h (T,) from that of the combined value."""
    if over == "mean":
        return np.full(len(h), bar / len(h))
    if over == "sum":
        return np.full(len(h), bar * control_step)
    if over == "product":  # by the product of all others, not by division: a factor may be zero
        before = np.cumprod(np.concatenate([[1.0], h[:-1]]))
        after = np.cumprod(np.concatenate([[1.0], h[:0:-1]]))[::-1]
        return np.asarray(bar * before * after)
    h_bar = np.zeros(len(h))
    h_bar[-1 if over == "final" else _extremal(h, over)] = bar
    return h_bar


def _extremal(h: Array, over: Over) -> int:
    return int(np.argmin(h.real) if over == "minimum" else np.argmax(h.real))

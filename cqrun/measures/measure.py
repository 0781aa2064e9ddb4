"""Base of measured quantities: numbers over time that a scene names once and uses in tables, terms and observers.

A quantity is bound to a scene's particles once. It names the weighted sums over particles that it needs, and computes
its numbers from the record of a run. All of them have an adjoint, so each can be a term of the objective, a constraint,
or an input of a controller.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from cqrun.observers.matter import Matter
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, Plugin

if TYPE_CHECKING:
    from scipy.sparse import csr_array

AXES = "xyz"


class BoundMeasure(ABC):
    """A measured quantity bound to one scene's particles.

    Attributes:
        rows: (K, N) weights of the sums over particles that it needs.
        components: the name of each of its n numbers, such as x and y; a single empty name for a single number.
        unit: SI unit of its numbers; 1 for none.
        meaning: what it is, in a few words, for files and plots.
        instant: whether an observer can see it: it depends on the motion at one moment, the motion of rigid bodies, the
            reactions and the activations up to there, and on strengths, lengths at rest and friction of actuators.
        cumulative: whether its numbers are sums over the control steps so far; those of a record of two moments are
            zero and what the step between them adds.
        low, high: (n,) the usual range of its numbers, which observers scale to [-1, 1].
    """

    rows: csr_array
    components: tuple[str, ...] = ("",)
    unit: str
    meaning: str
    instant: bool = True
    cumulative: bool = False
    low: Array = np.array([-1.0])
    high: Array = np.array([1.0])

    @abstractmethod
    def values(self, track: Track) -> Array:
        """Return its numbers (T+1, n) at control steps 0 .. T; NaN where there is none."""

    @abstractmethod
    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        """Return the cotangent of the track from that of `values`, which is 0 where there is none."""

    def continuous(self, values: Array) -> Array:
        """Return numbers of successive moments (T+1, n) without jumps, such as those of an angle after a full turn."""
        return values


class Measure(Plugin):
    """Base of the plug-ins of kind `measure`."""

    needs_time: ClassVar[bool] = False
    """Whether it has no meaning where bodies are at rest, as a velocity."""

    @property
    def boundaries(self) -> tuple[str, ...]:
        """The boundaries whose force and moment it needs, which only the reference frame has."""
        return ()

    @property
    def known_late(self) -> bool:
        """Whether it is known only when a run has ended: forces of boundaries, and the motion of rigid bodies."""
        return bool(self.boundaries)

    @abstractmethod
    def bind(self, matter: Matter) -> BoundMeasure:
        """Bind this quantity to a scene's particles.

        Raises:
            UsageError: a name or a number of particles does not fit the scene.
        """


def during(track: Track) -> Array:
    """Return the activations that acted up to each row of a track (T+1, A): in row 0 those of the first step."""
    return track.activation[np.maximum(np.arange(len(track.x)) - 1, 0)]


def during_vjp(track: Track, bar: Array) -> Array:
    """Return the cotangent of the activations (T, A) from that of `during`."""
    out = np.zeros(track.activation.shape)
    np.add.at(out, np.maximum(np.arange(len(track.x)) - 1, 0), bar)
    return out

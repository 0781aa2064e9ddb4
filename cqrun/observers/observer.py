"""Base of observers: at every control step an observer turns particles, time and goals into numbers for a controller.

A plug-in is bound to a scene's particles once. It names the weighted sums over particles that it needs, and at each
control step it gets only these. With `needs_state` it can read all particles.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.observers.matter import Matter, bind_each
from cqrun.observers.rows import slices, stacked
from cqrun.plugin.contract import Array, Plugin
from cqrun.state import State

if TYPE_CHECKING:
    from scipy.sparse import csr_array


SUMS = ("x", "v", "C", "F")
"""The parts of a moment that have a row for each sum over particles."""

WHOLE, BY_NAME = ("state", "activation", "strength", "rest_length", "friction"), ("rigid", "held")
"""The parts of a moment that all observers share, and those with several names; their cotangents add up."""


@dataclass
class Moment:
    """One control step, as an observer sees it.

    Attributes:
        x, v: (K, D) the observer's weighted sums of positions [m] and velocities [m/s].
        C, F: (K, D, D) the same sums of affine matrices [1/s] and deformation gradients.
        time: since the start [s].
        control: number of the control step, from 0.
        goals: goal -> its entries in this episode.
        memory: what the observer stored at the previous control step; zero at the start.
        state: returns the state of all particles, which it unpacks when called.
        rigid: rigid body -> displacement, rotation vector (2D: angle), velocity and angular velocity (6,) or (12,).
        held: boundary or rigid body -> force [N] and moment [N m] (D + 1,) or (6,) on the soft bodies: means over the
            control step that has ended, zero at the start. Only those that a measured quantity, a term or a recording
            of the scene names.
        activation: (A,) that acted in the control step that has ended; at the start those that do nothing.
        strength, rest_length, friction: (A',) of every part of actuators and forces, as in `Track`.
    """

    x: Array
    v: Array
    C: Array
    F: Array
    time: float
    control: int
    goals: Mapping[str, Array]
    memory: Array
    state: Callable[[], State]
    rigid: Mapping[str, Array] = field(default_factory=dict)
    held: Mapping[str, Array] = field(default_factory=dict)
    activation: Array = field(default_factory=lambda: np.zeros(0))
    strength: Array = field(default_factory=lambda: np.zeros(0))
    rest_length: Array = field(default_factory=lambda: np.zeros(0))
    friction: Array = field(default_factory=lambda: np.zeros(0))


@dataclass
class MomentBar:
    """The cotangent of a moment; None is zero."""

    x: Array | None = None
    v: Array | None = None
    C: Array | None = None
    F: Array | None = None
    memory: Array | None = None
    state: State | None = None
    rigid: Mapping[str, Array] | None = None
    held: Mapping[str, Array] | None = None
    activation: Array | None = None
    strength: Array | None = None
    rest_length: Array | None = None
    friction: Array | None = None


class BoundObserver(ABC):
    """An observer bound to one scene's particles.

    Attributes:
        size: number of values it gives.
        rows: (K, N) weights of the sums over particles that it needs.
        low, high: (size,) the range that is scaled to [-1, 1]; -1 and 1 leave a value as it is.
        n_memory: how many numbers it keeps from one control step to the next; they start at zero.
        needs_state: whether it calls `Moment.state`.
    """

    size: int
    rows: csr_array
    low: Array
    high: Array
    n_memory: int = 0
    needs_state: bool = False

    @abstractmethod
    def observe(self, moment: Moment) -> tuple[Array, Array]:
        """Return the values (size,) in their own units, and the next memory (n_memory,)."""

    @abstractmethod
    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        """Return the cotangent of the moment from those of the values and of the next memory."""


class Observer(Plugin):
    """Base of the plug-ins of kind `observer`."""

    @abstractmethod
    def bind(self, matter: Matter) -> BoundObserver:
        """Bind this observer to a scene's particles.

        Raises:
            UsageError: a name or a number of particles does not fit the scene.
        """


class Observation(BoundObserver):
    """Several observers as one: their values one after another, each scaled from its range to [-1, 1].

    Values outside the range are not clipped. `parts` maps an observer's name to the slice of its values.
    """

    low = high = np.zeros(0)

    def __init__(self, observers: Mapping[str, BoundObserver], n_particles: int) -> None:
        self.observers = list(observers.values())
        self.values = slices([o.size for o in self.observers])
        self.parts = dict(zip(observers, self.values, strict=True))
        self._rows = slices([o.rows.shape[0] for o in self.observers])
        self._memory = slices([o.n_memory for o in self.observers])
        self.size = sum(o.size for o in self.observers)
        self.n_memory = sum(o.n_memory for o in self.observers)
        self.needs_state = any(o.needs_state for o in self.observers)
        self.rows = stacked([o.rows for o in self.observers], n_particles)
        low, high = (_joined([getattr(o, side) for o in self.observers]) for side in ("low", "high"))
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)
        self.low, self.high = np.full(self.size, -1.0), np.full(self.size, 1.0)

    @classmethod
    def of(cls, observers: Mapping[str, Observer], matter: Matter) -> Observation:
        """Bind plug-ins to a scene's particles; `Unfit` if one of them does not fit."""
        return cls(bind_each(observers, matter), matter.n_particles)

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        observed = [o.observe(self._part(moment, k)) for k, o in enumerate(self.observers)]
        return (_joined([z for z, _ in observed]) - self.middle) / self.half, _joined(
            [memory for _, memory in observed]
        )

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        raw_bar = z_bar / self.half
        bars = [
            o.observe_vjp(self._part(moment, k), raw_bar[self.values[k]], memory_next_bar[self._memory[k]])
            for k, o in enumerate(self.observers)
        ]
        out = MomentBar(memory=joined_bar([b.memory for b in bars], self._memory, (self.n_memory,)))
        for name in SUMS:
            own = [getattr(b, name) for b in bars]
            setattr(out, name, joined_bar(own, self._rows, getattr(moment, name).shape))
        for name in WHOLE:
            setattr(out, name, _total([part for b in bars if (part := getattr(b, name)) is not None]))
        for name in BY_NAME:
            setattr(out, name, _by_name([part for b in bars if (part := getattr(b, name)) is not None]))
        return out

    def _part(self, moment: Moment, k: int) -> Moment:
        """Return the part of the moment that observer k reads."""
        rows = self._rows[k]
        own = {name: getattr(moment, name)[rows] for name in SUMS}
        return replace(moment, memory=moment.memory[self._memory[k]], **own)


def joined_bar(bars: Sequence[Array | None], places: Sequence[slice], shape: tuple[int, ...]) -> Array | None:
    """Join cotangents into one of `shape`, each at its place along the first axis; None if all are None."""
    if all(bar is None for bar in bars):
        return None
    out = np.zeros(shape)
    for bar, place in zip(bars, places, strict=True):
        if bar is not None:
            out[place] = bar
    return out


def _joined(parts: Sequence[Array]) -> Array:
    return np.concatenate([np.zeros(0), *parts])


def _total(bars: Sequence[Any]) -> Any:
    return reduce(add, bars) if bars else None


def _by_name(bars: Sequence[Mapping[str, Array]]) -> dict[str, Array] | None:
    """Return the sums of cotangents with the same name; None if there is none."""
    out: dict[str, Array] = {}
    for bar in bars:
        for name, part in bar.items():
            out[name] = out[name] + part if name in out else part
    return out or None

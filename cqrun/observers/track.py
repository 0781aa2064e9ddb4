"""The record of a run as readers see it: terms of the objective, and measured quantities; and its cotangent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cqrun.plugin.contract import Array


@dataclass
class Track:
    """The record of a run that a reader, such as a term of the objective, gets.

    Attributes:
        x, v: (T+1, K, D) the reader's weighted sums of positions [m] and velocities [m/s] at control steps 0 .. T.
        C, F: (T+1, K, D, D) the same sums of affine matrices [1/s] and deformation gradients.
        activation: (T, A) activations of the actuators.
        goals: goal -> its entries in this episode.
        control_step: length of a control step [s].
        design: (Q, N) rows of `objectives/design.py` for every particle.
        strength, rest_length, friction: (A',) of every part of actuators and forces; the first A have an activation.
            The unit of a strength is the part's own; a length is in [m], friction a coefficient [1].
        terms: parameters (rows, N_g) of each term of the stress of each group of bodies, as in `Inputs.terms`.
        weights: of each particle of each actuator, one part after another; empty if all are 1.
        held: force [N] and moment [N m] of the boundaries that readers need (T+1, D+1) or (T+1, 6), by name: means over
            each control step, which row 0 does not have (engine/reference/reactions.py).
        rest: positions of all particles at rest (N, D) [m].
        rigid: displacement, rotation vector (2D: angle), velocity and angular velocity (T+1, 6 or 12) of each rigid
            body, by name.
    """

    x: Array
    v: Array
    C: Array
    F: Array
    activation: Array
    goals: Mapping[str, Array]
    control_step: float
    design: Array = field(default_factory=lambda: np.zeros((0, 0)))
    held: Mapping[str, Array] = field(default_factory=dict)
    strength: Array = field(default_factory=lambda: np.zeros(0))
    rest_length: Array = field(default_factory=lambda: np.zeros(0))
    terms: Sequence[Sequence[Array]] = ()
    weights: Array = field(default_factory=lambda: np.zeros(0))
    rest: Array = field(default_factory=lambda: np.zeros((0, 0)))
    friction: Array = field(default_factory=lambda: np.zeros(0))
    rigid: Mapping[str, Array] = field(default_factory=dict)

    def part(self, at: slice) -> Track:
        """Return the record that a reader of some of the sums gets."""
        return replace(self, x=self.x[:, at], v=self.v[:, at], C=self.C[:, at], F=self.F[:, at])


@dataclass
class TrackBar:
    """The cotangent of a track; None is zero."""

    x: Array | None = None
    v: Array | None = None
    C: Array | None = None
    F: Array | None = None
    activation: Array | None = None
    design: Array | None = None
    held: dict[str, Array] | None = None
    strength: Array | None = None
    rest_length: Array | None = None
    terms: list[list[Array]] | None = None
    weights: Array | None = None
    rest: Array | None = None
    friction: Array | None = None
    rigid: dict[str, Array] | None = None

    @property
    def by_name(self) -> dict[str, dict[str, Array]]:
        """The parts that have a cotangent for each of several names: `held` and `rigid`."""
        return {"held": self.held or {}, "rigid": self.rigid or {}}

    def add_inputs_of(self, other: TrackBar) -> None:
        """Add the parts of another cotangent that belong to the inputs of a run, such as the design and the terms."""
        for name in ("design", "strength", "rest_length", "friction", "weights", "rest"):
            part, so_far = getattr(other, name), getattr(self, name)
            if part is not None:
                setattr(self, name, part if so_far is None else so_far + part)
        if other.terms is not None:
            self.terms = other.terms if self.terms is None else _sums(self.terms, other.terms)


def _sums(some: list[list[Array]], more: list[list[Array]]) -> list[list[Array]]:
    """Return the sum of two cotangents of the parameters of all terms of the stress."""
    return [[a + b for a, b in zip(*groups, strict=True)] for groups in zip(some, more, strict=True)]

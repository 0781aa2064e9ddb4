"""SQP with limited memory: constraints with any number of unknowns, linear in memory and time.

With rollouts linearised at x, and with the Hessian B of the Lagrangian by L-BFGS, an iteration solves

    minimise g.d + d.B d / 2   over   c_low <= c + J d <= c_high,   the box,   |d| <= radius

and takes the step if the merit f + rho sum |violation| falls by enough of the predicted decrease. A step that would be
rejected is corrected by the constraints' measured curvature along it, if the slopes at its end predict that this helps.
Without this second-order correction, steps along curved constraints stay short and end outside (the Maratos effect).
The radius shrinks if the predicted decrease was far too large, and if a trial blows up. The search for feasibility uses
no correction. Quadratic programs cost nothing compared with a rollout.
J. Nocedal, S. Wright: Numerical optimization (2006), sections 7.2 (compact L-BFGS, eq 7.24), 15.5 and 15.6
(second-order correction), 18.2 (damping) and 18.5 (S l1 QP).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import Field

from cqrun.optimizers.base import Status, TrialFailed
from cqrun.optimizers.constrained import ConstrainedTrials, most_violated, violation
from cqrun.optimizers.quadratic_program import LowRank, quadratic_program
from cqrun.optimizers.two_searches import Feasible, TwoSearches
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

TAKEN, GOOD, POOR = 1e-4, 0.75, 0.25
"""Parts of the predicted decrease of the merit: above TAKEN a step is taken, above GOOD the radius grows, below POOR it
shrinks."""

DAMPED = 0.2
"""Smallest allowed ratio of s.y to s.B s (Powell's damping)."""

LITTLE = 0.01
"""The search for feasibility ends when the predicted decrease is below this part of the constraint tolerance."""

SMALLEST = 1e-9
"""Smallest radius; below it the search ends."""

HEAVY, HEAVIER, ENOUGH = 10.0, 6, 0.9
"""The weight of violations is multiplied by the first number, at most as many times as the second, if that reduces
violations to the third."""

LIGHT = 2.0
"""The weight of violations is at most this factor times the last step's largest multiplier, or the initial weight."""


@plugin("optimizer", "sqp")
class Sqp(TwoSearches):
    """Sequential quadratic programming with limited memory, for any number of unknowns and few constraints.

    It first searches for a point that meets the constraints, without the objective, and then minimises the objective.
    """

    memory: int = Field(20, ge=1, le=1000, description="number of recent steps that determine the curvature")
    radius: float = Field(0.25, gt=0, description="initial limit of an unknown's step, in its scaled range")

    def search(
        self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array, *, feasibility: bool
    ) -> tuple[Status, str]:
        """Search once; in the search for feasibility f is 0, and `Feasible` is raised on success."""
        low, high = trials.problem.c_low, trials.problem.c_high
        here = _Point.of(x, trials.gradients(x), feasibility)
        curvature, radius, rho, failure_note = Curvature(self.memory), self.radius, 1.0, ""
        if feasibility:
            curvature.begin_at_constraints(here.J, violation(here.c, low, high))
        else:
            rho = curvature.begin_at_slope(here.g, here.J, radius)
        B, y, initial_rho, reset = curvature.of(np.zeros(len(low))), np.full(len(low), np.inf), rho, False
        while radius > SMALLEST:
            rho = min(rho, max(initial_rho, LIGHT * float(np.max(np.abs(y), initial=0.0))))
            room, ends = (lower - x, upper - x), (low - here.c, high - here.c)
            step = _step(B, here, ends, room, radius, rho)
            if not feasibility:
                step, rho = _steered(B, here, ends, room, radius, rho, step, self.constraint_tolerance)
            d, y, predicted = step.d, step.y, step.predicted(B, here, ends, rho)
            length = float(np.max(np.abs(d), initial=0.0))
            met = most_violated(here.c, low, high) <= self.constraint_tolerance
            least = LITTLE * self.constraint_tolerance if feasibility else self.function_tolerance if met else 0.0
            if predicted <= least:
                whole = _step(B, here, ends, room, self.radius, rho)  # a small radius may be the reason
                tolerance = least if feasibility else self.function_tolerance
                converged = (met or feasibility) and whole.predicted(B, here, ends, rho) <= tolerance
                if met and not converged and not reset:  # or the curvature from older steps
                    curvature.keep_last()
                    B, radius, reset = curvature.of(y), self.radius, True
                    continue
                message = f"SQP: a step of {length:.2g} is predicted to gain no more than {max(predicted, 0.0):.2g}"
                return ("converged" if converged else "stalled"), message
            try:
                there = _Point.of(x + d, trials.gradients(x + d), feasibility)
            except TrialFailed as failure:
                radius, failure_note = 0.5 * length, f"; the last trial: {failure}"
                continue
            failure_note, decrease = "", here.merit(rho, low, high) - there.merit(rho, low, high)
            if not decrease > TAKEN * predicted and not feasibility and violation(there.c, low, high).any():
                other = _corrected(trials, B, here, there, room, radius, rho, TAKEN * predicted)
                if other is not there:  # the curvature is updated with it instead of the trial
                    there, d = other, other.x - x
                    decrease = here.merit(rho, low, high) - there.merit(rho, low, high)
            if decrease < POOR * predicted:
                radius = 0.5 * length
            elif decrease > GOOD * predicted:
                radius = max(radius, 2.0 * length)
            curvature.update(d, there.g - here.g, there.J - here.J)  # rejected trials are as informative
            B = curvature.of(y)
            if not decrease > TAKEN * predicted:
                continue
            x, here, reset = there.x, there, False
            trials.accept(x)
            if feasibility and trials.violated(x) <= self.constraint_tolerance:
                raise Feasible
        return "stalled", f"SQP: no step reduces the merit any more{failure_note}"


class _Step(NamedTuple):
    """A step d, its multipliers y, and the sum of the violations that remain after it."""

    d: Array
    y: Array
    left: float

    def predicted(self, B: LowRank, here: _Point, ends: tuple[Array, Array], rho: float) -> float:
        """Return the decrease of the merit that the quadratic model predicts."""
        removed = float(np.sum(violation(np.zeros(len(here.c)), *ends))) - self.left
        return rho * removed - float(here.g @ self.d + 0.5 * self.d @ B.times(self.d))


def _step(
    B: LowRank, here: _Point, ends: tuple[Array, Array], room: tuple[Array, Array], radius: float, rho: float
) -> _Step:
    """Return the best step within the radius for a weight rho of the violations."""
    box = np.maximum(room[0], -radius), np.minimum(room[1], radius)
    d, y = quadratic_program(B, here.g, here.J, ends, box, rho)
    return _Step(d, y, float(np.sum(violation(here.J @ d, *ends))))


def _steered(
    B: LowRank, here: _Point, ends: tuple[Array, Array], room: tuple[Array, Array], radius: float, rho: float,
    first: _Step, tolerance: float,
) -> tuple[_Step, float]:  # fmt: skip
    """Return a step and its weight of violations, which is increased if that leaves much smaller violations.

    A short form of R. H. Byrd, J. Nocedal, R. A. Waltz: Steering exact penalty methods for nonlinear programming,
    Optim. Methods Softw. 23 (2008). Violations within the tolerance need no larger weight. A weight that does not help
    may be followed by one that does, so the smallest weight is taken that is nearly as good as the best.
    """
    tried = [(first, rho)]
    while tried[-1][0].left > tolerance and len(tried) <= HEAVIER:
        weight = HEAVY * tried[-1][1]
        tried.append((_step(B, here, ends, room, radius, weight), weight))
    least = min(step.left for step, _ in tried)
    if not least < ENOUGH * first.left:
        return first, rho
    sufficient = max(tolerance, least + (1.0 - ENOUGH) * (first.left - least))
    return next((step, weight) for step, weight in tried if step.left <= sufficient)


def _corrected(
    trials: ConstrainedTrials, B: LowRank, here: _Point, there: _Point, room: tuple[Array, Array], radius: float,
    rho: float, enough: float,
) -> _Point:  # fmt: skip
    """Return the end of a step corrected by the constraints' values at `there`, or `there` if that is better.

    The correction is tried only if the known slopes at `there` predict that the merit falls by enough.
    """
    low, high = trials.problem.c_low, trials.problem.c_high
    constant = there.c - here.J @ (there.x - here.x)
    x = here.x + _step(B, here, (low - constant, high - constant), room, radius, rho).d
    predicted = there.moved(x - there.x)
    if not here.merit(rho, low, high) - predicted.merit(rho, low, high) > enough:
        return there
    try:
        other = _Point.of(x, trials.gradients(x), feasibility=False)
    except TrialFailed:
        return there
    return other if other.merit(rho, low, high) < there.merit(rho, low, high) else there


class _Point(NamedTuple):
    """A point x with f, its gradient, constraints and their Jacobian."""

    x: Array
    f: float
    g: Array
    c: Array
    J: Array

    @classmethod
    def of(cls, x: Array, answer: dict[str, Array], feasibility: bool) -> _Point:
        f, g = (0.0, np.zeros(len(x))) if feasibility else (float(answer["f"]), answer["g"])
        return cls(x, f, g, answer["c"], answer["J"])

    def moved(self, e: Array) -> _Point:
        """Return the linear prediction at x + e."""
        return _Point(self.x + e, self.f + float(self.g @ e), self.g, self.c + self.J @ e, self.J)

    def merit(self, rho: float, low: Array, high: Array) -> float:
        return self.f + rho * float(np.sum(violation(self.c, low, high)))


class Curvature:
    """The Hessian B of the Lagrangian f + y.c for any multipliers y, from recent steps s and the changes along them.

    B = delta I - W M^-1 W^T, W = [delta S, Y], M = [[delta S^T S, L], [L^T, -D]], where S^T Y = L + D + R. Multipliers
    change from step to step, so Y is computed again from the changes of f's gradient and c's Jacobian.
    """

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self.first = 1.0
        self.changes: list[tuple[Array, Array, Array]] = []

    def begin_at_slope(self, g: Array, J: Array, radius: float) -> float:
        """Start with the multiple of the identity whose first step has the radius' length; return a violations' weight.

        With this weight a violation costs as much as f, because neither has a natural scale.
        """
        slope = float(np.max(np.abs(g), initial=0.0)) or 1.0
        self.first = slope / radius
        return slope / (float(np.max(np.abs(J), initial=0.0)) or slope)

    def begin_at_constraints(self, J: Array, excess: Array) -> None:
        """Start with a multiple of the identity for which multipliers of the first step to c + J d = 0 are below 1."""
        size = np.einsum("ij,ij->i", J, J)[excess > 0.0]
        self.first = 0.1 * float(np.min(size / excess[excess > 0.0], initial=1.0)) or 1.0

    def update(self, s: Array, g_change: Array, J_change: Array) -> None:
        """Add a step s (n,) with the changes of f's gradient (n,) and c's Jacobian (m, n)."""
        if s.any():
            self.changes = [*self.changes, (s, g_change, J_change)][-self.memory :]

    def keep_last(self) -> None:
        """Forget all steps but the last."""
        self.changes = self.changes[-1:]

    def of(self, y: Array) -> LowRank:
        """Return B for multipliers y (m,), with each pair damped so that B stays positive definite."""
        steps = [(s, g_change + y @ J_change) for s, g_change, J_change in self.changes]
        delta = self.first
        for s, change in steps:
            delta = max(float(s @ change) / float(s @ s), DAMPED * delta)
        B = LowRank(delta)
        pairs: list[tuple[Array, Array]] = []
        for s, change in steps:
            pairs.append((s, _damped(B, s, change)))
            S, Y = (np.array(side).T for side in zip(*pairs, strict=True))
            SY = S.T @ Y
            L = np.tril(SY, -1)
            M = np.block([[delta * (S.T @ S), L], [L.T, -np.diag(np.diag(SY))]])
            B = LowRank(delta, np.hstack([delta * S, Y]), M)
        return B


def _damped(B: LowRank, s: Array, change: Array) -> Array:
    """Return the change of a slope along s, or a mean of it and B s that keeps B positive definite (Powell)."""
    Bs = B.times(s)
    sBs, sy = float(s @ Bs), float(s @ change)
    if sy >= DAMPED * sBs:
        return change
    part = (1.0 - DAMPED) * sBs / (sBs - sy)
    return part * change + (1.0 - part) * Bs

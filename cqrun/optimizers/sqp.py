"""SQP with limited memory: constraints with any number of unknowns, first-order in memory and time.

An iteration solves, with rollouts linearised at x and B the Hessian of the Lagrangian by L-BFGS,

    minimise g.d + d.B d / 2   over   c_low <= c + J d <= c_high,   the box,   |d| <= radius

and takes the step if the merit f + rho sum |violation| falls by enough of what that promised. A step that would be
refused is corrected by how the constraints were found to bend along it, where slopes at its end say that this helps:
without that, steps along curved constraints stay short and end outside (the Maratos effect). The radius shrinks where a
step promised far too much, and where a trial blows up. The search for feasibility corrects nothing.
Quadratic programs cost nothing beside a rollout. J. Nocedal, S. Wright: Numerical optimization (2006), sections 7.2
(compact L-BFGS, eq 7.24), 15.5 and 15.6 (second-order correction), 18.2 (damping) and 18.5 (S l1 QP).
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
"""Part of the promised fall of the merit at which a step is taken, the radius grows, and it shrinks."""

DAMPED = 0.2
"""Least part of s.B s that s.y may be (Powell's damping)."""

LITTLE = 0.01
"""Part of the tolerance of constraints that the search for feasibility must promise to go on."""

SMALLEST = 1e-9
"""Radius at which no step helps any more."""

HEAVY, HEAVIER, ENOUGH = 10.0, 6, 0.9
"""The weight of violations grows by this factor at a time, so often at most, where they fall to this part."""

LIGHT = 2.0
"""The weight of violations is at most this many times the largest multiplier of the last step, or that of the start."""


@plugin("optimizer", "sqp")
class Sqp(TwoSearches):
    """Sequential quadratic programming with limited memory, for any number of unknowns and few constraints.

    It first looks for a point that meets the constraints, without the objective, and then lowers that.
    """

    memory: int = Field(20, ge=1, description="last steps that the curvature is made of")
    radius: float = Field(0.25, gt=0, description="longest step of an unknown at the start, in its scaled range")

    def search(
        self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array, *, feasibility: bool
    ) -> tuple[Status, str]:
        """Search once; for feasibility alone f counts as 0, and `Feasible` is raised on success."""
        low, high = trials.problem.c_low, trials.problem.c_high
        here = _Point.of(x, trials.gradients(x), feasibility)
        curvature, radius, rho, last = Curvature(self.memory), self.radius, 1.0, ""
        if feasibility:
            curvature.begin_at_constraints(here.J, violation(here.c, low, high))
        else:
            rho = curvature.begin_at_slope(here.g, here.J, radius)
        B, y, least, anew = curvature.of(np.zeros(len(low))), np.full(len(low), np.inf), rho, False
        while radius > SMALLEST:
            rho = min(rho, max(least, LIGHT * float(np.max(np.abs(y), initial=0.0))))
            room, ends = (lower - x, upper - x), (low - here.c, high - here.c)
            step = _step(B, here, ends, room, radius, rho)
            if not feasibility:
                step, rho = _steered(B, here, ends, room, radius, rho, step, self.constraint_tolerance)
            d, y, promised = step.d, step.y, step.promised(B, here, ends, rho)
            length = float(np.max(np.abs(d), initial=0.0))
            met = most_violated(here.c, low, high) <= self.constraint_tolerance
            little = LITTLE * self.constraint_tolerance if feasibility else self.function_tolerance if met else 0.0
            if promised <= little:
                free = _step(B, here, ends, room, self.radius, rho)  # the radius may be what keeps the promise small
                enough = little if feasibility else self.function_tolerance
                found = (met or feasibility) and free.promised(B, here, ends, rho) <= enough
                if met and not found and not anew:  # or what older steps say of the curvature
                    curvature.keep_last()
                    B, radius, anew = curvature.of(y), self.radius, True
                    continue
                told = f"SQP: a step of {length:.2g} promises no more than {max(promised, 0.0):.2g}"
                return ("converged" if found else "stalled"), told
            try:
                there = _Point.of(x + d, trials.gradients(x + d), feasibility)
            except TrialFailed as failure:
                radius, last = 0.5 * length, f"; the last trial: {failure}"
                continue
            last, fallen = "", here.merit(rho, low, high) - there.merit(rho, low, high)
            if not fallen > TAKEN * promised and not feasibility and violation(there.c, low, high).any():
                other = _corrected(trials, B, here, there, room, radius, rho, TAKEN * promised)
                if other is not there:  # learned from in the trial's stead
                    there, d = other, other.x - x
                    fallen = here.merit(rho, low, high) - there.merit(rho, low, high)
            if fallen < POOR * promised:
                radius = 0.5 * length
            elif fallen > GOOD * promised:
                radius = max(radius, 2.0 * length)
            curvature.learn(d, there.g - here.g, there.J - here.J)  # a trial that is not taken tells as much
            B = curvature.of(y)
            if not fallen > TAKEN * promised:
                continue
            x, here, anew = there.x, there, False
            trials.accept(x)
            if feasibility and trials.violated(x) <= self.constraint_tolerance:
                raise Feasible
        return "stalled", f"SQP: no step lowers the merit any more{last}"


class _Step(NamedTuple):
    """A step d, its multipliers y, and the sum of violations that it leaves."""

    d: Array
    y: Array
    left: float

    def promised(self, B: LowRank, here: _Point, ends: tuple[Array, Array], rho: float) -> float:
        """Return by how much the merit falls in the model."""
        less = float(np.sum(violation(np.zeros(len(here.c)), *ends))) - self.left
        return rho * less - float(here.g @ self.d + 0.5 * self.d @ B.times(self.d))


def _step(
    B: LowRank, here: _Point, ends: tuple[Array, Array], room: tuple[Array, Array], radius: float, rho: float
) -> _Step:
    """Return the best step within the radius for a weight of the violations."""
    box = np.maximum(room[0], -radius), np.minimum(room[1], radius)
    d, y = quadratic_program(B, here.g, here.J, ends, box, rho)
    return _Step(d, y, float(np.sum(violation(here.J @ d, *ends))))


def _steered(
    B: LowRank, here: _Point, ends: tuple[Array, Array], room: tuple[Array, Array], radius: float, rho: float,
    found: _Step, tolerance: float,
) -> tuple[_Step, float]:  # fmt: skip
    """Return the step and the weight, larger where that leaves markedly less of the violations.

    R. H. Byrd, J. Nocedal, R. A. Waltz: Steering exact penalty methods for nonlinear programming, Optim. Methods Softw.
    23 (2008), in short. What is left within the tolerance needs no more; a weight that does not help may be followed by
    one that does, so the lightest is taken that comes near to what any leaves.
    """
    tried = [(found, rho)]
    while tried[-1][0].left > tolerance and len(tried) <= HEAVIER:
        weight = HEAVY * tried[-1][1]
        tried.append((_step(B, here, ends, room, radius, weight), weight))
    least = min(step.left for step, _ in tried)
    if not least < ENOUGH * found.left:
        return found, rho
    enough = max(tolerance, least + (1.0 - ENOUGH) * (found.left - least))
    return next((step, weight) for step, weight in tried if step.left <= enough)


def _corrected(
    trials: ConstrainedTrials, B: LowRank, here: _Point, there: _Point, room: tuple[Array, Array], radius: float,
    rho: float, enough: float,
) -> _Point:  # fmt: skip
    """Return where a step ends that meets what the constraints were found to be at `there`, or that if it is better.

    It is tried where the slopes at `there`, which are known, foresee that the merit falls by enough.
    """
    low, high = trials.problem.c_low, trials.problem.c_high
    constant = there.c - here.J @ (there.x - here.x)
    x = here.x + _step(B, here, (low - constant, high - constant), room, radius, rho).d
    foreseen = there.moved(x - there.x)
    if not here.merit(rho, low, high) - foreseen.merit(rho, low, high) > enough:
        return there
    try:
        other = _Point.of(x, trials.gradients(x), feasibility=False)
    except TrialFailed:
        return there
    return other if other.merit(rho, low, high) < there.merit(rho, low, high) else there


class _Point(NamedTuple):
    """What is known at a point: f, its gradient, constraints and their Jacobian."""

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
        """Return what slopes foresee at x + e."""
        return _Point(self.x + e, self.f + float(self.g @ e), self.g, self.c + self.J @ e, self.J)

    def merit(self, rho: float, low: Array, high: Array) -> float:
        return self.f + rho * float(np.sum(violation(self.c, low, high)))


class Curvature:
    """The Hessian B of the Lagrangian f + y.c for any multipliers y, from the last steps s and what changed there.

    B = delta I - W M^-1 W^T, W = [delta S, Y], M = [[delta S^T S, L], [L^T, -D]], where S^T Y = L + D + R. Multipliers
    come and go from step to step, so Y is made anew from the changes of the gradient of f and of the Jacobian of c.
    """

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self.first = 1.0
        self.changes: list[tuple[Array, Array, Array]] = []

    def begin_at_slope(self, g: Array, J: Array, radius: float) -> float:
        """Take the multiple of the identity whose first step is as long as the radius; return a weight of violations.

        It is that at which a violation costs as much as f: neither has a scale of its own.
        """
        slope = float(np.max(np.abs(g), initial=0.0)) or 1.0
        self.first = slope / radius
        return slope / (float(np.max(np.abs(J), initial=0.0)) or slope)

    def begin_at_constraints(self, J: Array, excess: Array) -> None:
        """Take a multiple of the identity with which the multipliers of the first step to c + J d = 0 are below 1."""
        size = np.einsum("ij,ij->i", J, J)[excess > 0.0]
        self.first = 0.1 * float(np.min(size / excess[excess > 0.0], initial=1.0)) or 1.0

    def learn(self, s: Array, g_change: Array, J_change: Array) -> None:
        """Take in a step s (n,), and the changes of the gradient (n,) of f and of the Jacobian (m, n) of c."""
        if s.any():
            self.changes = [*self.changes, (s, g_change, J_change)][-self.memory :]

    def keep_last(self) -> None:
        """Forget all steps but the last."""
        self.changes = self.changes[-1:]

    def of(self, y: Array) -> LowRank:
        """Return B for multipliers y (m,), each pair damped so that it stays positive."""
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
    """Return the change of a slope along s, or one between it and B s that leaves B positive (Powell)."""
    Bs = B.times(s)
    sBs, sy = float(s @ Bs), float(s @ change)
    if sy >= DAMPED * sBs:
        return change
    part = (1.0 - DAMPED) * sBs / (sBs - sy)
    return part * change + (1.0 - part) * Bs

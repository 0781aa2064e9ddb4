"""Augmented Lagrangian over Adam: constraints with any number of unknowns, one gradient an iteration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self, cast, final

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.optimizers.adam import AdamSteps
from cqrun.optimizers.base import Outcome, Problem, refuse_stochastic, require_finite, terms_of
from cqrun.optimizers.constrained import (
    ConstrainedOptimizer,
    ConstrainedProblem,
    Kkt,
    columns_of,
    infeasible,
    most_violated,
    projected,
    ranked,
    require_constraints,
    violation,
)
from cqrun.optimizers.first_order import DescentState, Merit
from cqrun.optimizers.quadratic_program import LowRank, quadratic_program
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

LONGEST = 0.1
"""Of a step to the constraints, in an unknown's scaled range."""

HELPS = 0.75
"""Part to which such a step must bring the violation, or it counts as one that does not help."""

HEAVY = 1e6
"""Weight of what such a step leaves of the violations, beside its length."""


@plugin("optimizer", "augmented_lagrangian")
class AugmentedLagrangian(ConstrainedOptimizer, AdamSteps):
    """Adam on f + sum |c - p + y / rho|^2 rho / 2, where p is the allowed value nearest to c + y / rho.

    Its gradient is that of f + w.c with w = y + rho (c - p), which one backward run gives for all constraints. Every
    `inner` iterations the multipliers y become w, and the penalty rho grows where the violation has not fallen enough.
    Then come steps of another kind: the shortest ones that meet the constraints linearised at x (Gauss and Newton's),
    until `restoring` of them have hardly lowered the violation: a penalty is slow to give its last digits.
    J. Nocedal, S. Wright: Numerical optimization (2006), sections 15.4 (normal steps), 17.3 and 17.4.
    """

    max_iterations: int = Field(500, ge=1, description="iterations at most")
    beta2: float = Field(0.99, ge=0, lt=1, description="memory of the mean square: short, as the penalty changes it")
    decay: float = Field(0.01, ge=0, description="the learning rate of iteration k is divided by 1 + decay k")
    inner: int = Field(50, ge=1, description="iterations between two updates of the multipliers")
    penalty: float = Field(3.0, gt=0, description="rho at the start")
    growth: float = Field(2.0, gt=1, description="by which rho grows")
    enough: float = Field(0.5, gt=0, lt=1, description="part to which the violation must fall, or rho grows")
    penalty_limit: float = Field(100.0, gt=0, description="rho grows no further")
    restoring: int = Field(
        2, ge=0, description="steps straight to the constraints, after each update, that may hardly help; 0: none"
    )

    @model_validator(mode="after")
    def _leaves_room(self) -> Self:
        if self.restoring >= self.inner:
            raise ValueError(f"`restoring` must be below `inner` ({self.inner}): nothing would lower the objective")
        return self

    def require(self, problem: Problem) -> None:
        """Refuse what has no constraints to ask for, and what changes from iteration to iteration."""
        require_constraints(problem, self.name)
        refuse_stochastic(problem, self)
        if self.batch_size is not None:
            raise UsageError("constraints are of the whole set: remove `batch_size`")

    @final
    def merit(self, problem: Problem) -> Merit:
        """Return the augmented Lagrangian of a problem, which `require` has seen to have constraints."""
        return LagrangianMerit(self, cast(ConstrainedProblem, problem))


@dataclass(frozen=True)
class LagrangianMerit(Merit):
    """The augmented Lagrangian of a problem, as a method's fields shape it."""

    method: AugmentedLagrangian
    problem: ConstrainedProblem

    def memory(self, x: Array) -> dict[str, Array]:
        """Return the multipliers, the penalty, and what they were last judged by."""
        return {
            "multipliers": np.zeros(len(self.problem.constraint_names)),
            "penalty": np.array(self.method.penalty),
            "restoring": np.array(0),
            "last": np.array(np.inf),
            "violation": np.array(np.inf),
            "best": np.full(3, np.inf),
        }

    def evaluate(self, x: Array, batch: tuple[int, ...] | None, memory: dict[str, Array]) -> dict[str, Array]:
        """Return f, the gradient of the augmented Lagrangian, constraints c and weights w (m,), and the terms."""
        y, rho = memory["multipliers"], memory["penalty"]
        held, tolerance = self.problem, self.method.constraint_tolerance
        low, high = held.c_low, held.c_high

        def weigh(c: Array) -> Array:
            aim = c + y / rho
            return np.asarray(rho * (aim - np.clip(aim, low, high)))

        normal = {}
        if memory["restoring"] > 0:
            f, g, c, J = held.gradients_and_constraints(x)
            require_finite(x, constraints=c, jacobian=J)
            g = g + weigh(c) @ J
            normal = {"normal": self._normal_step(x, c, J)}
        else:
            f, c, g = held.lagrangian(x, weigh)
        require_finite(x, loss=np.asarray(f), constraints=c, gradient=g)
        terms = np.array(held.term_values(), float)
        judged = {
            "violation": np.array(most_violated(c, low, high)),
            "rank": np.array(ranked(violation(c, low, high), float(f), tolerance)),
        }
        return {"f": np.array(f, float), "g": g, "c": c, "w": weigh(c), "terms": terms} | judged | normal

    def _normal_step(self, x: Array, c: Array, J: Array) -> Array:
        """Return the shortest step (n,) in the box that meets the linearised constraints, cut to `LONGEST`."""
        problem = self.problem
        # a little inside, so that it does not end on the edge; an equality stays one
        inside = np.minimum(0.5 * self.method.constraint_tolerance, 0.5 * (problem.c_high - problem.c_low))
        ends = problem.c_low + inside - c, problem.c_high - inside - c
        box = np.maximum(problem.lower - x, -1.0), np.minimum(problem.upper - x, 1.0)
        d, _ = quadratic_program(LowRank(1.0), np.zeros(len(x)), J, ends, box, HEAVY)
        return np.asarray(d * min(1.0, LONGEST / max(float(np.max(np.abs(d), initial=0.0)), LONGEST)))

    def learn(self, iteration: int, answer: dict[str, Array], memory: dict[str, Array]) -> dict[str, Array]:
        """Return the memory with the multipliers and the penalty moved on where they are due."""
        method = self.method
        memory = memory | {
            "best": np.array(min(tuple(memory["best"]), tuple(answer["rank"]))),
            "restoring": np.array(self._left(memory, float(answer["violation"]))),
            "last": answer["violation"],
        }
        if iteration == 0 or iteration % method.inner:
            return memory
        rho = memory["penalty"]
        if answer["violation"] > max(method.constraint_tolerance, method.enough * memory["violation"]):
            rho = np.minimum(method.growth * rho, method.penalty_limit)
        return memory | {
            "multipliers": answer["w"], "penalty": rho, "violation": answer["violation"],
            # the step to the next point is still Adam's, and hardly helps
            "restoring": np.array(method.restoring + (method.restoring > 0)),
        }  # fmt: skip

    def _left(self, memory: dict[str, Array], excess: float) -> int:
        """Return how many steps to the constraints are to follow: one that helps does not count."""
        if excess <= self.method.constraint_tolerance:
            return 0
        return max(0, int(memory["restoring"]) - (excess > HELPS * float(memory["last"])))

    def step(self, usual: Array, answer: dict[str, Array]) -> Array:
        """Return the step of Adam, or minus the one straight to the constraints: whole, or it would never help."""
        return -answer["normal"] if "normal" in answer else usual

    def better(self, state: DescentState, answer: dict[str, Array]) -> bool:
        """Say whether an evaluation violates less than all before, or nothing and is lower."""
        return tuple(answer["rank"]) < tuple(state.memory["best"])

    def columns(self, x: Array, answer: dict[str, Array]) -> dict[str, float]:
        """Return the terms and what is known of the constraints; the weights are the multipliers."""
        found = Kkt(answer["w"], projected(self.problem, x, answer["g"]))
        return terms_of(self.problem, answer["terms"]) | columns_of(self.problem, answer["c"], found)

    def may_converge(self, memory: dict[str, Array]) -> bool:
        """Say whether the last point, not only the best so far, meets the constraints."""
        return float(memory["last"]) <= self.method.constraint_tolerance

    def concluded(self, outcome: Outcome) -> Outcome:
        """Return the outcome, with status `infeasible` and a verdict where its point violates constraints."""
        if outcome.status in ("failed", "stopped"):
            return outcome
        problem, tolerance = self.problem, self.method.constraint_tolerance
        _, c = problem.values_and_constraints(outcome.x)
        if most_violated(c, problem.c_low, problem.c_high) <= tolerance:
            return outcome
        return infeasible(problem, outcome, c, tolerance)

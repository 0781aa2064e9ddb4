"""Augmented Lagrangian with Adam: constraints with any number of unknowns, one gradient per iteration."""

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
    projected_norm,
    ranked,
    require_constraints,
    violation,
)
from cqrun.optimizers.first_order import DescentState, Merit
from cqrun.optimizers.quadratic_program import LowRank, quadratic_program
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

LONGEST_STEP = 0.1
"""Longest step towards the constraints, in the scaled range of an unknown."""

HELPFUL = 0.75
"""Part to which such a step must reduce the violation to count as one that helps."""

VIOLATION_WEIGHT = 1e6
"""Weight of the remaining violations in such a step, compared with its length."""


@plugin("optimizer", "augmented_lagrangian")
class AugmentedLagrangian(ConstrainedOptimizer, AdamSteps):
    """Adam on f + sum |c - p + y / rho|^2 rho / 2, where p is the allowed value nearest to c + y / rho.

    Its gradient is that of f + w.c with w = y + rho (c - p); a single backward run gives it for all constraints. Every
    `inner` iterations the multipliers y are set to w, and the penalty rho grows if the violation has not fallen enough.
    Then come restoration steps: the shortest ones that meet the constraints linearised at x (Gauss-Newton), until
    `restoring` of them have hardly reduced the violation. They give the last digits, where a penalty converges slowly.
    J. Nocedal, S. Wright: Numerical optimization (2006), sections 15.4 (normal steps), 17.3 and 17.4.
    """

    max_iterations: int = Field(500, ge=1, description="maximum number of iterations")
    beta2: float = Field(0.99, ge=0, lt=1, description="memory of the mean square; short, because the penalty changes")
    decay: float = Field(0.01, ge=0, description="the learning rate of iteration k is divided by 1 + decay k")
    inner: int = Field(50, ge=1, description="iterations between two updates of the multipliers")
    penalty: float = Field(3.0, gt=0, description="rho at the start")
    growth: float = Field(2.0, gt=1, description="factor by which rho grows")
    enough: float = Field(0.5, gt=0, lt=1, description="part to which the violation must fall; otherwise rho grows")
    penalty_limit: float = Field(100.0, gt=0, description="largest rho")
    restoring: int = Field(
        2, ge=0, description="number of restoration steps after each update that may fail to help; 0: none"
    )

    @model_validator(mode="after")
    def _leaves_room(self) -> Self:
        if self.restoring >= self.inner:
            raise ValueError(f"`restoring` must be below `inner` ({self.inner}): nothing would lower the objective")
        return self

    def require(self, problem: Problem) -> None:
        """Raise UsageError for a fit to data, an objective that changes between iterations, or mini-batches."""
        require_constraints(problem, self.name)
        refuse_stochastic(problem, self)
        if self.batch_size is not None:
            raise UsageError("constraints apply to the whole set: remove `batch_size`")

    @final
    def merit(self, problem: Problem) -> Merit:
        """Return the augmented Lagrangian of a problem, which `require` has checked for constraints."""
        return LagrangianMerit(self, cast(ConstrainedProblem, problem))


@dataclass(frozen=True)
class LagrangianMerit(Merit):
    """Augmented Lagrangian of a problem, with the parameters of its method."""

    method: AugmentedLagrangian
    problem: ConstrainedProblem

    def initial_memory(self, x: Array) -> dict[str, Array]:
        """Return the multipliers, the penalty, and the values that decide on their next update."""
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
        constrained, tolerance = self.problem, self.method.constraint_tolerance
        low, high = constrained.c_low, constrained.c_high

        def weigh(c: Array) -> Array:
            shifted = c + y / rho
            return np.asarray(rho * (shifted - np.clip(shifted, low, high)))

        normal = {}
        if memory["restoring"] > 0:
            f, g, c, J = constrained.gradients_and_constraints(x)
            require_finite(x, constraints=c, jacobian=J)
            g = g + weigh(c) @ J
            normal = {"normal": self._normal_step(x, c, J)}
        else:
            f, c, g = constrained.lagrangian(x, weigh)
        require_finite(x, loss=np.asarray(f), constraints=c, gradient=g)
        terms = np.array(constrained.term_values(), float)
        progress = {
            "violation": np.array(most_violated(c, low, high)),
            "rank": np.array(ranked(violation(c, low, high), float(f), tolerance)),
        }
        return {"f": np.array(f, float), "g": g, "c": c, "w": weigh(c), "terms": terms} | progress | normal

    def _normal_step(self, x: Array, c: Array, J: Array) -> Array:
        """Return the shortest step (n,) in the box that meets the linearised constraints, cut to `LONGEST_STEP`."""
        problem = self.problem
        # slightly inside the limits, not on them; an equality stays one
        inside = np.minimum(0.5 * self.method.constraint_tolerance, 0.5 * (problem.c_high - problem.c_low))
        ends = problem.c_low + inside - c, problem.c_high - inside - c
        box = np.maximum(problem.lower - x, -1.0), np.minimum(problem.upper - x, 1.0)
        d, _ = quadratic_program(LowRank(1.0), np.zeros(len(x)), J, ends, box, VIOLATION_WEIGHT)
        return np.asarray(d * min(1.0, LONGEST_STEP / max(float(np.max(np.abs(d), initial=0.0)), LONGEST_STEP)))

    def update_memory(self, iteration: int, answer: dict[str, Array], memory: dict[str, Array]) -> dict[str, Array]:
        """Return the memory after an evaluation; every `inner` iterations with new multipliers and penalty."""
        method = self.method
        memory = memory | {
            "best": np.array(min(tuple(memory["best"]), tuple(answer["rank"]))),
            "restoring": np.array(self._remaining_steps(memory, float(answer["violation"]))),
            "last": answer["violation"],
        }
        if iteration == 0 or iteration % method.inner:
            return memory
        rho = memory["penalty"]
        if answer["violation"] > max(method.constraint_tolerance, method.enough * memory["violation"]):
            rho = np.minimum(method.growth * rho, method.penalty_limit)
        return memory | {
            "multipliers": answer["w"], "penalty": rho, "violation": answer["violation"],
            # one more, because the step to the next point is still Adam's and counts as one that does not help
            "restoring": np.array(method.restoring + (method.restoring > 0)),
        }  # fmt: skip

    def _remaining_steps(self, memory: dict[str, Array], excess: float) -> int:
        """Return how many restoration steps that do not help may still follow."""
        if excess <= self.method.constraint_tolerance:
            return 0
        return max(0, int(memory["restoring"]) - (excess > HELPFUL * float(memory["last"])))

    def step(self, usual: Array, answer: dict[str, Array]) -> Array:
        """Return Adam's step, or minus the restoration step, which is not scaled: a part of it would never help."""
        return -answer["normal"] if "normal" in answer else usual

    def better(self, state: DescentState, answer: dict[str, Array]) -> bool:
        """Return whether an evaluation is the best so far: least violation first, then lowest loss."""
        return tuple(answer["rank"]) < tuple(state.memory["best"])

    def history_columns(self, x: Array, answer: dict[str, Array]) -> dict[str, float]:
        """Return the terms and the columns of the constraints, with the weights as multipliers."""
        optimality = Kkt(answer["w"], projected_norm(self.problem, x, answer["g"]))
        return terms_of(self.problem, answer["terms"]) | columns_of(self.problem, answer["c"], optimality)

    def may_converge(self, memory: dict[str, Array]) -> bool:
        """Return whether the last point, not only the best one, meets the constraints."""
        return float(memory["last"]) <= self.method.constraint_tolerance

    def concluded(self, outcome: Outcome) -> Outcome:
        """Return the outcome, with status `infeasible` and a message if its point violates constraints."""
        if outcome.status in ("failed", "stopped"):
            return outcome
        problem, tolerance = self.problem, self.method.constraint_tolerance
        _, c = problem.values_and_constraints(outcome.x)
        if most_violated(c, problem.c_low, problem.c_high) <= tolerance:
            return outcome
        return infeasible(problem, outcome, c, tolerance)

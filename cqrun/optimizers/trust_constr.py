"""trust-constr: a trust-region interior point method, for smooth constraints and some hundred unknowns."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from pydantic import Field

from cqrun.optimizers.base import Problem, Status
from cqrun.optimizers.constrained import ConstrainedTrials, Kkt, ReplayedConstrained
from cqrun.optimizers.slsqp import require_room, require_size
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

INSIDE = 1e-6
"""Smallest distance of the start from the bounds, in scaled coordinates."""


@plugin("optimizer", "trust_constr")
class TrustConstr(ReplayedConstrained):
    """Trust-region interior point: equalities by projected steps, bounds and inequalities by a barrier that shrinks.

    R. H. Byrd, M. E. Hribar, J. Nocedal: An interior point algorithm for large-scale nonlinear programming, SIAM J.
    Optim. 9 (1999); scipy's implementation, the Hessian by BFGS.
    """

    max_iterations: int = Field(200, ge=1, description="maximum number of iterations")
    gradient_tolerance: float = Field(1e-6, gt=0, description="converged when the Lagrangian's gradient is smaller")
    step_tolerance: float = Field(1e-8, gt=0, description="converged when the trust region is smaller")

    def require(self, problem: Problem) -> None:
        """Raise UsageError also for a problem that is too large or has more equalities than unknowns."""
        super().require(problem)
        require_size(problem, self.name, matrices=1.0)  # its Hessian; factorisations need more
        require_room(problem, self.name)

    def attempt(self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        """Run scipy's method once."""
        from scipy.optimize import BFGS, Bounds, NonlinearConstraint, minimize

        low, high = trials.problem.c_low, trials.problem.c_high
        edge = np.minimum(INSIDE, 0.25 * (upper - lower))
        x = np.clip(x, lower + edge, upper - edge)  # its barrier is infinite on the bounds
        constraints = [
            NonlinearConstraint(
                lambda x: trials.values(x)[1], low, high, jac=lambda x: trials.gradients(x)["J"], hess=BFGS()
            )
        ] * bool(len(low))

        def accept(x: Array, state: Any) -> None:
            # the barrier keeps x inside all limits, so only its multipliers show which constraints are active
            y = np.asarray(state.v[0]) if len(low) else np.zeros(0)
            trials.accept(np.asarray(x), Kkt(y, max(state.optimality, getattr(state, "barrier_parameter", 0.0))))

        with warnings.catch_warnings():  # scipy warns about linear constraints and about redundant ones
            warnings.filterwarnings("ignore", message="delta_grad == 0.0|Singular Jacobian matrix")
            result = minimize(
                lambda x: trials.values(x)[0],
                x,
                jac=lambda x: trials.gradients(x)["g"],
                hess=BFGS(),
                method="trust-constr",
                bounds=Bounds(lower, upper, keep_feasible=True),
                constraints=constraints,
                callback=accept,
                options={"maxiter": 2**31 - 1, "gtol": self.gradient_tolerance, "xtol": self.step_tolerance},
            )
        return ("converged" if result.status in (1, 2) else "stalled"), f"trust-constr: {result.message}"

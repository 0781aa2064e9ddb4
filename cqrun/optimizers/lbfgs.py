"""L-BFGS-B: a quasi-Newton method with bounds, for many unknowns and exact gradients."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.optimizers.base import Status
from cqrun.optimizers.replayed import Replayed, Trials
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

STOPPED_BY_CALLBACK = 99
"""scipy's status if the callback raises StopIteration."""


@plugin("optimizer", "lbfgs")
class Lbfgs(Replayed):
    """L-BFGS-B: x <- x - alpha H g inside the bounds, H from the last `memory` pairs (s, y).

    For smooth losses of any number of unknowns. A line search finds alpha (strong Wolfe conditions).
    R. H. Byrd, P. Lu, J. Nocedal, C. Zhu: A limited memory algorithm for bound constrained
    optimization, SIAM J. Sci. Comput. 16 (1995); scipy's implementation.
    """

    max_iterations: int = Field(100, ge=1, description="maximum number of iterations")
    memory: int = Field(10, ge=1, le=1000, description="number of pairs (s, y) for the inverse Hessian")
    function_tolerance: float = Field(
        1e-10, ge=0, description="converged when an iteration reduces the loss by less than this part of it"
    )
    gradient_tolerance: float = Field(
        1e-8, ge=0, description="converged when no component of the projected gradient is larger"
    )
    line_search_steps: int = Field(20, ge=1, le=1000, description="maximum number of trials in a line search")

    def attempt(self, trials: Trials, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        """Run scipy's method once."""
        from scipy.optimize import Bounds, minimize

        unlimited = 2**31 - 1  # the callback counts iterations, over all restarts
        last = np.inf

        def accept(x: Array) -> None:
            nonlocal last
            trials.accept(x)
            loss = trials.loss_at(x)
            if last - loss <= self.function_tolerance * abs(loss):  # scipy's own test is absolute below 1
                raise StopIteration
            last = loss

        result = minimize(
            trials.value_and_grad,
            x,
            jac=True,
            method="L-BFGS-B",
            bounds=Bounds(lower, upper),
            callback=accept,
            options={
                "maxcor": self.memory,
                "ftol": 0.0,
                "gtol": self.gradient_tolerance,
                "maxls": self.line_search_steps,
                "maxiter": unlimited,
                "maxfun": unlimited,
            },
        )
        if result.status == STOPPED_BY_CALLBACK:
            return "converged", "an iteration reduced the loss by less than the function tolerance"
        return ("converged" if result.status == 0 else "stalled"), str(result.message)

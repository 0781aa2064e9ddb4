"""Trust-region least squares, for few unknowns and many residuals."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.optimizers.base import Status
from cqrun.optimizers.replayed import Replayed, Trials
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

INSIDE = 0.01
"""Distance from a bound, in widths of the box, that a start has at least."""


@plugin("optimizer", "least_squares")
class LeastSquares(Replayed):
    """Trust-region reflective least squares: min |r(x)|^2 / 2, steps from (J^T J + D) p = -J^T r.

    The default for up to 10 unknowns with marker data. It uses all residuals, not only their sum of squares, so it
    converges in few iterations, each with one Jacobian.
    M. A. Branch, T. F. Coleman, Y. Li: A subspace, interior, and conjugate gradient method for
    large-scale bound-constrained minimization problems, SIAM J. Sci. Comput. 21 (1999); scipy's TRF.
    """

    gradients: ClassVar[bool] = False
    squares: ClassVar[bool] = True
    max_iterations: int = Field(30, ge=1, description="maximum number of iterations")
    function_tolerance: float = Field(
        1e-8,
        ge=2.3e-16,
        description="converged when an iteration reduces the loss by less than this part of it",
    )
    step_tolerance: float = Field(
        1e-8, ge=2.3e-16, description="converged when a step is shorter than this part of |x|"
    )
    gradient_tolerance: float = Field(
        1e-8, ge=2.3e-16, description="converged when no component of the scaled gradient is larger"
    )

    def attempt(self, trials: Trials, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        """Run scipy's method once.

        It starts inside the bounds. At a bound, scipy would move the start by 1e-10, and take the length of that, if
        all else is 0, as the radius of its trust region: it would end there, as converged.
        """
        from scipy.optimize import least_squares

        width = upper - lower
        inside = INSIDE * np.where(np.isfinite(width), width, 0.0)
        result = least_squares(
            trials.residuals,
            np.clip(x, lower + inside, upper - inside),
            jac=trials.jacobian,
            bounds=(lower, upper),
            method="trf",
            x_scale=1.0,
            tr_solver="exact",
            ftol=self.function_tolerance,
            xtol=self.step_tolerance,
            gtol=self.gradient_tolerance,
            max_nfev=2**31 - 1,  # the callback counts iterations, over all restarts
            callback=trials.accept,
        )
        return ("converged" if result.status > 0 else "stalled"), str(result.message)

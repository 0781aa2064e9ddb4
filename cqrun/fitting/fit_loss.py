"""The loss of a fit, as `cqrun gradcheck` differentiates it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cqrun.build.model import Built
from cqrun.fitting.case import Case
from cqrun.fitting.problem import FitProblem
from cqrun.plugin.contract import Array
from cqrun.running.state_loss import INSIDE, Loss
from cqrun.running.unknowns import make_params


def fit_loss(built: Built, cases: Sequence[Case], threads: int) -> Loss:
    """Return the loss that `cqrun sysid` minimises, at the scene's start values."""
    params = make_params(built)
    problem = FitProblem(cases, params, threads=threads)

    def value(x: Array) -> float:
        r = problem.residuals(x)
        return 0.5 * float(r @ r)

    x = np.clip(params.start, INSIDE, 1.0 - INSIDE)
    moved = "" if np.array_equal(x, params.start) else ", a little inside the bounds"
    words = f"the fit's loss, in units of {problem.unit_text}{moved},"
    return Loss(words, params, x, value, problem.value_and_grad, 0.0)

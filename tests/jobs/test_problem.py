"""A fit's rollouts: run once where points ask for the same, and shared by recordings' starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cqrun.jobs.cases import Case, make_cases
from cqrun.jobs.problem import FitProblem, make_params
from cqrun.scene.build import build
from cqrun.scene.load import load_scene

START = "data.recordings.swing.start"


@pytest.fixture
def problem(fit):
    """Return a fit whose recording begins at an unknown time."""
    built = build(load_scene(fit, ()))
    params = make_params(built)
    blocks = (*params.blocks, replace(params.blocks[0], path=START, lower=-0.01, upper=0.01, log=False,
                                      initial=np.array(0.0)))  # fmt: skip
    (case,) = make_cases(built)
    return FitProblem([replace(case, start_path=START)], replace(params, blocks=blocks))


def test_a_start_takes_no_rollout_of_its_own(problem, monkeypatch):
    ran, run = [], Case.run

    def counted(self, values, *rest):
        ran.append(dict(values))
        return run(self, values, *rest)

    monkeypatch.setattr(Case, "run", counted)
    x = problem.start
    r, J = problem.residuals_and_jacobian(x)
    assert len(ran) == 1 + len(x) - 1
    assert np.abs(J[:, -1]).max() > 0
    assert np.array_equal(problem.residuals(x), r)
    assert len(ran) == len(x)
    moved = x + 1e-3
    later, alone = problem.residuals(moved), FitProblem(problem.cases, problem.params).residuals(moved)
    assert np.array_equal(later, alone)
    assert not np.array_equal(later, r)

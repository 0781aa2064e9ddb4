"""A fit's rollouts: run once where points ask for the same, and shared by recordings' starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_beam import record, recorded

from cqrun.build.model import build
from cqrun.errors import CrushedError, RolloutError
from cqrun.fitting.case import Case
from cqrun.fitting.cases import make_cases
from cqrun.fitting.problem import FitProblem
from cqrun.fitting.runners import InMotion
from cqrun.optimizers.base import TrialFailed
from cqrun.running.unknowns import make_params
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

    def counted(self, values, *rest, **near):
        ran.append(dict(values))
        return run(self, values, *rest, **near)

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


def test_values_are_those_of_the_gradient_whatever_runs_side_by_side(problem):
    points = [problem.start, problem.start + 0.05]
    wanted = [problem.value_and_grad(x)[0] for x in points]
    values = problem.values_at(points)
    assert values == pytest.approx(wanted, rel=1e-12)
    assert [problem.value(x) for x in points] == values
    assert problem.value(points[1], (0,)) == pytest.approx(values[1], rel=1e-14)
    assert FitProblem(problem.cases, problem.params, threads=2).values_at(points) == values


def test_a_trial_that_blows_up_spoils_no_other(problem, monkeypatch):
    x, bad = problem.start, problem.start + 0.05
    run = Case.run

    def fragile(self, values, *rest, **near):
        if values.keys() == problem.values(bad).keys() and all(
            np.array_equal(values[path], value) for path, value in problem.values(bad).items()
        ):
            raise RolloutError("left the grid", body="beam", particle=3, time=0.1, advice="use a stiffer one")
        return run(self, values, *rest, **near)

    monkeypatch.setattr(Case, "run", fragile)
    failure, value = problem.values_at([bad, x])
    assert isinstance(failure, TrialFailed)
    assert "body 'beam', particle 3" in str(failure)
    assert value == problem.value(x)
    with pytest.raises(TrialFailed):
        problem.value(bad)


def test_a_failed_trial_names_its_recording(problem, monkeypatch):
    def blows_up(*rest, **named):
        raise RolloutError("left the grid", body="beam", particle=3, time=0.1, advice="use a stiffer one")

    for name in ("run", "gradient"):
        monkeypatch.setattr(InMotion, name, blows_up)
    name = problem.cases[0].name
    for evaluate in (problem.value, problem.value_and_grad, problem.residuals):
        with pytest.raises(
            TrialFailed, match=f"particle 3, t = 0.1 s: recording '{name}': left the grid; use a stiffer"
        ):
            evaluate(problem.start)


def test_still_values_are_scaled_like_their_residuals(fit, tmp_path):
    files = record(fit, tmp_path / "data", copies=2)
    entries = {"still": "[0, 0.03]", "start": "0.03", "length": "0.06"}
    built = build(load_scene(recorded(fit, dict(zip("ab", files, strict=True)), **entries),
                             ["data.recordings.b.weight=3", "data.recordings.b.length=0.05"]))  # fmt: skip
    cases = make_cases(built)
    problem = FitProblem(cases, make_params(built))
    values = problem.values(problem.start)
    plain = np.concatenate([case.residuals(case.run(values), values)[0] for case in cases])
    scales = problem.residuals(problem.start) / plain
    series = problem.series()
    assert len({s.recording for s in series}) == len(np.unique(scales.round(9))) == 2
    for k, s in enumerate(series):
        marker, axis = divmod(k % 4, 2)
        still = cases[s.recording].comparisons[0].still
        assert len(still) > 1
        np.testing.assert_allclose(s.still, scales[s.where[0]] * still[:, marker, axis], rtol=1e-12)


def test_a_crushed_marker_fails_the_trial_not_the_run(problem, monkeypatch):
    def crushed(self, record, values):
        raise CrushedError("the material at a marker is crushed", "narrow the bounds")

    monkeypatch.setattr(Case, "residuals", crushed)
    with pytest.raises(TrialFailed, match="crushed; narrow the bounds; trial values: bodies"):
        problem.residuals(problem.start)

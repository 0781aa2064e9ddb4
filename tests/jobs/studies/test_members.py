"""Which runs of a study are there already, and what is said of those that failed."""

from __future__ import annotations

import json

import pytest

from cqrun.errors import UsageError
from cqrun.fingerprint import engine_hash
from cqrun.jobs.control import CONTROL
from cqrun.jobs.studies.members import Executor, unfinished
from cqrun.running.fleet import Member
from cqrun.scene.schema import Scene


@pytest.fixture
def made(tmp_path):
    """Return a function that makes the folder of a run with a status, and its member."""

    def make(status, report=True, fresh=False, **facts):
        run = tmp_path / status
        run.mkdir()
        record = {"status": status, "seconds": 1.0, "reason": "its tip is too far", "engine": engine_hash(), **facts}
        (run / "run.json").write_text(json.dumps(record))
        if report:
            (run / "report.html").touch()
        return Member(status, run, ["cqrun", "control", "--fresh" if fresh else "--quiet"], 2)

    return make


@pytest.mark.parametrize("status", ["done", "converged", "iteration_limit", "stalled"])
def test_a_finished_run_with_its_report_is_there(made, status):
    run = made(status)
    assert unfinished([run]) == []
    assert run.failure is None


@pytest.mark.parametrize(("status", "failure"), [("converged", None), ("failed", "its tip is too far")])
def test_a_finished_run_of_another_engine_is_left_alone(made, status, failure):
    run = made(status, report=False, engine="0" * 12)
    assert unfinished([run]) == []
    assert run.failure == failure


def test_a_run_that_failed_or_is_infeasible_is_there_and_says_why(made):
    runs = [made("infeasible"), made("failed", report=False)]
    assert unfinished(runs) == []
    assert [run.failure for run in runs] == ["its tip is too far"] * 2


@pytest.mark.parametrize(
    ("status", "facts"),
    [
        ("stopped", {}),
        ("running", {}),
        ("new", {}),
        ("converged", {"report": False}),
        ("infeasible", {"report": False}),
        ("stopped", {"engine": "0" * 12}),
        ("converged", {"plugins": {"law.py": "0" * 64}}),
        ("converged", {"fresh": True}),
        ("failed", {"fresh": True}),
    ],
)
def test_all_others_are_made(made, status, facts):
    run = made(status, **facts)
    assert unfinished([run]) == [run]
    assert run.failure is None


def test_a_run_that_was_never_begun_is_made(tmp_path):
    run = Member("seed 0", tmp_path / "0", ["cqrun"], 2)
    assert unfinished([run]) == [run]


def test_a_place_that_is_none_is_refused_before_anything_is_made(tmp_path):
    scene = Scene.model_construct()
    with pytest.raises(UsageError, match="--on moon: no such place; there are processes, dask, "):
        Executor(tmp_path / "finger.yaml", tmp_path, scene, CONTROL, 1, "moon")

"""The table of jobs is the one list of them: scenes, results, commands and pictures agree with it."""

from __future__ import annotations

import json
from typing import get_args

import pytest
from small_beam import BEAM
from small_finger import FINGER

from cqrun.cli.app import COMMANDS
from cqrun.errors import SceneError, UsageError
from cqrun.figures.draw import PICTURES
from cqrun.jobs.table import JOBS, job_of, report_lines
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene
from cqrun.scene.sections import JobName
from cqrun.store.result import LEARNED, GradcheckResult, Result, write_result
from cqrun.store.run import read_record


def test_a_scene_may_name_each_job_and_no_other():
    assert set(get_args(JobName)) == JOBS.keys()
    assert all(job.name == name for name, job in JOBS.items())


def test_each_job_is_a_command():
    assert JOBS.keys() <= {command.__name__ for command in COMMANDS}


def test_each_job_has_a_result_and_each_result_a_job():
    names = [name for model in get_args(Result) for name in get_args(model.model_fields["job"].annotation)]
    assert sorted(names) == sorted(JOBS)
    for name, job in JOBS.items():
        assert name in get_args(job.result.model_fields["job"].annotation)
    assert [name for name in JOBS if name in LEARNED] == list(LEARNED)


def test_each_picture_of_a_job_can_be_drawn_and_each_picture_is_one_of_a_job():
    assert {picture for job in JOBS.values() for picture in job.pictures} == PICTURES.keys()


def test_the_sections_that_a_job_needs_are_sections_of_a_scene():
    scene = load_scene(BEAM)
    for job in JOBS.values():
        for need in job.needs:
            assert hasattr(scene, need.section)
            assert need.instead is None or hasattr(scene, need.instead)


@pytest.mark.parametrize("name", [name for name, job in JOBS.items() if job.needs])
def test_a_scene_that_lacks_sections_is_told_of_all_of_them(name):
    with pytest.raises(SceneError) as error:
        JOBS[name].prepare(load_scene(BEAM), 1, Silent())
    told = [(problem.path, problem.message) for problem in error.value.problems]
    assert told == [(need.section, f"{name} needs it: {need.advice}") for need in JOBS[name].needs]


def test_constraints_stand_in_for_an_objective():
    limit = "constraints={up: {of: {height: {body: finger, group: tip, axis: y}}, at_least: 0.3}}"
    JOBS["control"].prepare(load_scene(FINGER, ["objective=null", "optimizer=null", limit]), 1, Silent())
    with pytest.raises(SceneError, match="objective: control needs it"):
        JOBS["control"].prepare(load_scene(FINGER, ["objective=null"]), 1, Silent())


@pytest.fixture
def run(tmp_path):
    """Return a run that has been stopped and has no result."""
    (tmp_path / "run.json").write_text(
        json.dumps({"job": "simulate", "status": "stopped", "seconds": 1.0, "reason": "asked to"})
    )
    return tmp_path


def test_a_run_without_result_tells_its_status(run):
    assert report_lines(run) == ["simulate: stopped (asked to)"]


def test_a_run_of_an_unknown_job_is_refused(run):
    (run / "run.json").write_text(json.dumps(read_record(run) | {"job": "fit"}))
    for ask in (job_of, report_lines):
        with pytest.raises(UsageError, match="a run of 'fit', which this version of cqrun does not know; it knows sys"):
            ask(run)


def test_a_result_of_another_job_than_the_run_is_refused(run):
    write_result(run, GradcheckResult(agrees=True, loss=1.0, of="it", steps=[], rows=[]))
    with pytest.raises(UsageError, match="is a run of simulate, but its result is one of gradcheck"):
        report_lines(run)

"""A request to stop is heard between any two rollouts and in every phase; exit code 75, and what is said is true."""

from __future__ import annotations

import os
import signal

import pytest
from small_beam import BEAM, FIT, Listener, assert_same
from small_finger import FINGER, written

from cqrun.errors import Stopped
from cqrun.fitting.case import Case
from cqrun.jobs.control import run_control
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.resume import run_resume
from cqrun.jobs.sysid import run_sysid
from cqrun.learning.agent import Agent
from cqrun.running import state_loss
from cqrun.store.run import read_record

METHODS = {
    "least_squares": "optimizer={least_squares: {max_iterations: 3}}",
    "lbfgs": "optimizer={lbfgs: {max_iterations: 3}}",
    "adam": "optimizer={adam: {max_iterations: 3}}",
    "cma_es": "optimizer={cma_es: {max_iterations: 2, population: 4}}",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stopped")
    (folder / "fit.yaml").write_text(BEAM + FIT)
    written(folder, FINGER)
    return folder


@pytest.fixture(scope="module")
def undisturbed(folder):
    """Return a function that runs a fit to its end, once for each optimizer."""
    runs = {}

    def run(method):
        if method not in runs:
            runs[method] = run_sysid(folder / "fit.yaml", [METHODS[method]], folder / "whole" / method, threads=1)
        return runs[method]

    return run


@pytest.fixture
def stopping(monkeypatch):
    """Return a function that asks to stop in the k-th call of a method, and then counts the calls."""

    def patch(cls, name, k):
        listener, count, real = Listener(), [0], getattr(cls, name)

        def counted(*arguments, **options):
            count[0] += 1
            if count[0] == k:
                listener.stop.ask(signal.SIGTERM)
            return real(*arguments, **options)

        monkeypatch.setattr(cls, name, counted)
        return listener, count

    return patch


@pytest.mark.parametrize("k", [1, 2, 3, 4])
@pytest.mark.parametrize("method", METHODS)
def test_a_fit_is_stopped_after_the_rollout_at_hand_and_continued(folder, undisturbed, stopping, tmp_path, method, k):
    """With least squares the second and third rollout are of the first Jacobian."""
    whole = undisturbed(method)
    name = "gradient" if method in ("lbfgs", "adam") else "run"
    listener, count = stopping(Case, name, k)
    with pytest.raises(Stopped) as ended:
        run_sysid(folder / "fit.yaml", [METHODS[method]], tmp_path, threads=1, reporter=listener)
    assert count[0] == k
    (run,) = tmp_path.glob("fit/*")
    assert ended.value.exit_code == 75
    assert str(ended.value).endswith(f"; `cqrun resume {run}` continues")
    rows = (run / "history.csv").read_text().count("\n") - 1
    when = "before the first iteration" if rows == 0 else f"after iteration {rows - 1}"
    told = (f"SIGTERM: asked to stop {when}", "SIGTERM: stopped before its results were written")
    assert str(ended.value).startswith(told)
    assert read_record(run)["status"] == "stopped"
    run_resume(run, [], threads=1)
    assert_same(run, whole)


def test_a_run_that_is_stopped_before_it_makes_data_continues(folder, undisturbed, tmp_path):
    listener = Listener()
    listener.stop.ask(signal.SIGTERM)
    with pytest.raises(Stopped, match=r"stopped before its results were written; `cqrun resume .*` continues"):
        run_sysid(folder / "fit.yaml", [METHODS["adam"]], tmp_path, threads=1, reporter=listener)
    (run,) = tmp_path.glob("fit/*")
    run_resume(run, [], threads=1)
    assert_same(run, undisturbed("adam"))


@pytest.mark.parametrize("k", [1, 3, 6])
def test_learning_is_stopped_between_two_episodes(folder, stopping, tmp_path, k):
    listener, count = stopping(Agent, "attempt_with_gradients", k)
    with pytest.raises(Stopped, match="continues"):
        run_control(folder / "finger.yaml", [], tmp_path, threads=1, reporter=listener)
    assert count[0] <= k


def test_a_gradient_check_is_stopped_between_two_rollouts(folder, stopping, tmp_path):
    listener, count = stopping(state_loss.Rollout, "run", 7)
    with pytest.raises(Stopped, match=r"stopped before its results were written; `cqrun resume .*` starts it again"):
        run_gradcheck(folder / "fit.yaml", ["unknowns={}", "data=null"], tmp_path, threads=1, reporter=listener)
    assert count[0] == 7


def _kill(*arguments, **options):
    os.kill(os.getpid(), signal.SIGTERM)


def test_a_signal_while_pictures_are_drawn_keeps_the_results(cqrun, folder, tmp_path, monkeypatch, pictures):
    monkeypatch.setattr("cqrun.figures.draw.draw_run", _kill)
    words = ("simulate", folder / "fit.yaml", "-o", "time.duration=0.02", "--out", tmp_path)
    code, out, err = cqrun(*words)
    (run,) = tmp_path.glob("fit/*")
    assert code == 75
    assert out.endswith(f"run: {run}\n")
    told = (
        f"error: SIGTERM: stopped while pictures were drawn; the run is finished, and `cqrun plot {run}` draws them\n"
    )
    assert err.endswith(told)
    assert read_record(run)["status"] == "done"
    monkeypatch.undo()
    assert cqrun("plot", run)[0] == 0


@pytest.mark.parametrize("place", ["cqrun.running.kernels._one_substep", "cqrun.jobs.simulate.build_and_warn"])
def test_a_signal_before_the_work_ends_the_command_at_once(cqrun, folder, tmp_path, monkeypatch, place):
    monkeypatch.setattr(place, _kill)
    words = ("simulate", folder / "fit.yaml", "-o", "time.duration=0.02", "--out", tmp_path)
    code, out, err = cqrun(*words)
    assert (code, out) == (75, "")
    assert err.endswith("error: SIGTERM: stopped before it was finished; give the command again\n")
    for run in tmp_path.glob("fit/*"):
        assert read_record(run)["status"] == "new"
    monkeypatch.undo()
    assert cqrun(*words)[0] == 0


@pytest.mark.parametrize("words", [["validate"], ["describe", "elastic"], ["schema"]])
def test_a_signal_ends_commands_without_runs(cqrun, folder, monkeypatch, words):
    monkeypatch.setattr("typer.echo", _kill)
    code, _, err = cqrun(*words, *([folder / "fit.yaml"] if words == ["validate"] else []))
    assert code == 75
    assert err.endswith("error: SIGTERM: stopped before it was finished; give the command again\n")

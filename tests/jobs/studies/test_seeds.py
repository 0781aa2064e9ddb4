"""`cqrun control --seeds N`: runs of their own, side by side, and what they have in common."""

from __future__ import annotations

import csv
import itertools
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_beam import Listener, assert_same, changed, result_of
from small_finger import written

from cqrun.errors import Stopped, UsageError
from cqrun.jobs.resume import run_resume
from cqrun.jobs.studies import members, seeds
from cqrun.jobs.studies.seeds import _summary, interval, run_seeds, summary_lines
from cqrun.running.fleet import Member
from cqrun.running.runs import EXTENDED
from cqrun.store.study import Mean, SeedsSummary, write_study


@pytest.fixture
def finger(tmp_path):
    """Return the scene of the small finger, of two iterations."""
    path = written(tmp_path)
    changed(path, "max_iterations: 4", "max_iterations: 2")
    return path


def test_the_interval_is_students():
    """4 +- t_{0.95, 2} s / sqrt(3) with t = 2.919986 of the tables and s = 2."""
    found = interval([2.0, 4.0, 6.0])
    half = 2.919986 * 2.0 / np.sqrt(3.0)
    assert [found.mean, found.low, found.high] == pytest.approx([4.0, 4.0 - half, 4.0 + half], rel=1e-6)
    assert interval([3.0]) == Mean(mean=3.0, low=None, high=None)


def test_every_seed_is_a_run_of_its_own_and_all_are_summed_up(finger, tmp_path, monkeypatch):
    listener = Listener()
    path, good = run_seeds(finger, [], tmp_path / "out", threads=2, seeds=2, jobs=2, reporter=listener)
    assert good
    summary = json.loads(path.read_text())
    # a process of its own, as each seed is: it takes the same compiled kernels from the cache
    command = [sys.executable, "-m", "cqrun", "control", str(finger), "-o", "seed=1", "--threads", "1", "-q"]
    subprocess.run([*command, "--out", str(tmp_path / "alone")], check=True, stdout=subprocess.DEVNULL)
    (alone,) = (tmp_path / "alone" / "finger").iterdir()
    run = tmp_path / "out" / "finger" / alone.name
    assert summary["seeds"]["1"]["run"] == str(run)
    assert_same(run, alone)  # to the bit, also of its file of activations
    losses = [entry["trained"]["loss"] for entry in summary["seeds"].values()]
    assert losses[1] == result_of(alone)["trained"]["loss"] != losses[0]
    assert summary["all"]["trained"]["loss"] == interval(losses).model_dump()
    assert set(summary["all"]) == {"start", "trained", "unseen"}
    assert set(summary["all"]["unseen"]) == {"tip", "effort", "loss"}
    rows = {row["seed"]: row for row in csv.DictReader(path.with_suffix(".csv").read_text().splitlines())}
    assert list(rows) == ["0", "1", "mean", "low", "high"]
    assert float(rows["high"]["trained:tip"]) == summary["all"]["trained"]["tip"]["high"]
    text = "\n".join(summary_lines(path))
    assert text.startswith("2 of 2 seeds learned; mean and 90% interval over them")
    assert f"to draw them together: cqrun plot {summary['seeds']['0']['run']} {run}" in text
    assert any(line.startswith("learning from 2 seeds, 2 at once") for line in listener.said)
    assert listener.parts[-1][2] == "2 of 2 seeds"
    # the same command again starts no process
    again = Listener()
    with monkeypatch.context() as patch:
        patch.setattr(Member, "start", None)
        assert run_seeds(finger, [], tmp_path / "out", threads=2, seeds=2, jobs=2, reporter=again) == (path, True)
    assert again.said[-1].endswith("; 2 of 2 seeds are there already")
    assert not any("compiling" in line for line in again.said)
    assert json.loads(path.read_text()) == summary
    # and with one that failed, or with one alone
    runs = [Member(f"seed {k}", Path(entry["run"]), [], 2) for k, entry in enumerate(summary["seeds"].values())]
    runs[0].failure = "blew up"
    write_study(path, _summary("finger", runs))
    lines = summary_lines(path)
    assert lines[0].startswith("1 of 2 seeds learned")
    assert f"seed 0 failed: {runs[0].run}: blew up" in lines
    assert json.loads(path.read_text())["all"]["trained"]["loss"] == {"mean": losses[1], "low": None, "high": None}
    # and with one that went on for longer
    run_resume(run, ["optimizer.adam.max_iterations=3"], threads=1)
    write_study(path, _summary("finger", runs))
    assert f"warning: seed 1: {EXTENDED}" in summary_lines(path)


def test_means_are_of_the_seeds_that_meet_their_constraints_if_any_does(tmp_path):
    made = []
    for k, (status, loss) in enumerate((("infeasible", 1.0), ("converged", 4.0), ("converged", 6.0))):
        run = tmp_path / str(k)
        run.mkdir()
        stage = {"loss": loss, "terms": {"tip": loss}, "episodes": []}
        facts = {"job": "control", "status": status, "message": "", "loss": loss, "iterations": 2, "unknowns": {}}
        (run / "result.json").write_text(json.dumps(facts | {"start": stage, "trained": stage, "unseen": None}))
        (run / "run.json").write_text(json.dumps({"status": status, "seconds": 1.0}))
        made.append(Member(f"seed {k}", run, [], 2, failure=None if status == "converged" else "its constraints"))
    path, found = tmp_path / "summary.json", {}
    for name, some in (("mixed", made), ("infeasible", made[:1])):
        found[name] = _summary("finger", some)
        write_study(path, found[name])
        lines = summary_lines(path)
        assert lines[0].startswith({"mixed": "2 of 3", "infeasible": "0 of 1 seeds meet"}[name])
        assert "seed 0 does not meet its constraints" in lines
    assert found["mixed"].all["trained"]["loss"] == interval([4.0, 6.0])
    assert found["mixed"].seeds["0"].trained == {"tip": 1.0, "loss": 1.0}
    assert found["infeasible"].all["trained"]["loss"] == interval([1.0])


def test_seeds_that_change_nothing_are_told(tmp_path):
    same = {"mean": 2.0, "low": 2.0, "high": 2.0}
    seeds = {k: {"run": f"results/finger/{k}", "status": "converged"} for k in range(2)}
    path = tmp_path / "summary.json"
    path.write_text(json.dumps({"scene": "s", "confidence": 0.9, "seeds": seeds, "all": {"trained": {"loss": same}}}))
    assert "note: all seeds have the same result: nothing in this scene depends on its seed" in summary_lines(path)


def test_seeds_that_will_change_nothing_are_warned_of(finger, tmp_path, monkeypatch):
    monkeypatch.setattr(members, "run_fleet", lambda *rest: None)
    monkeypatch.setattr(seeds, "_summary", lambda *rest: SeedsSummary(scene="s", confidence=0.9, seeds={}, all={}))
    warned = {}
    for controller, optimizer in itertools.product(
        ["{}", "{noise: 0.1}"], ["adam: {}", "adam: {mask: 0.2}", "cma_es: {}", "lbfgs: {}"]
    ):
        listener = Listener()
        overrides = [f"controller={{open_loop: {controller}}}", f"optimizer={{{optimizer}}}", "observers={}"]
        run_seeds(finger, overrides, tmp_path, threads=1, seeds=2, reporter=listener)
        warned[controller, optimizer] = any("nothing in this scene depends on its seed" in s for s in listener.said)
    assert {key for key, told in warned.items() if told} == {("{}", "adam: {}"), ("{}", "lbfgs: {}")}


def test_a_stopped_command_says_how_to_go_on(finger, tmp_path, monkeypatch):
    def stopped(runs, at_once, what, talk):
        runs[1].failure = "asked to stop"
        talk.stop.ask(signal.SIGINT)

    monkeypatch.setattr(members, "run_fleet", stopped)
    with pytest.raises(Stopped, match="2 of 3 seeds are finished; the same command continues the others") as ended:
        run_seeds(finger, [], tmp_path, threads=1, seeds=3)
    assert ended.value.exit_code == 130
    assert not list(tmp_path.glob("finger/summary*"))


def test_permission_and_fresh_are_handed_on(finger, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(members, "run_fleet", lambda runs, at_once, *rest: asked.append((runs[2].command, at_once)))
    monkeypatch.setattr(seeds, "_summary", lambda *rest: SeedsSummary(scene="s", confidence=0.9, seeds={}, all={}))
    run_seeds(finger, ["time.duration=0.05"], tmp_path, fresh=True, threads=4, seeds=3, jobs=2, allow_plugins=True)
    command, at_once = asked[0]
    assert at_once == 2
    assert command[:6] == [sys.executable, "-P", "-m", "cqrun", "control", str(finger)]
    assert command[command.index("--threads") + 1] == "2"
    assert {"--fresh", "--allow-plugins", "time.duration=0.05", "seed=2"} <= set(command)


@pytest.mark.parametrize(
    ("overrides", "options", "message"),
    [
        ([], {"seeds": 0}, "--seeds 0: must be at least 1"),
        ([], {"seeds": 10**9}, "--seeds 1000000000: must be at most 10,000: each is a run of its own"),
        ([], {"seeds": 2, "jobs": 0}, "--jobs 0: must be at least 1"),
        (["seed=3"], {"seeds": 2}, "-o seed=3: --seeds gives every run a seed of its own"),
    ],
)
def test_what_cannot_be_is_refused(finger, tmp_path, overrides, options, message):
    with pytest.raises(UsageError, match=message):
        run_seeds(finger, overrides, tmp_path / "out", threads=1, **options)
    assert not (tmp_path / "out").exists()

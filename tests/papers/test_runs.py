"""Tasks that are commands of cqrun: what they are, how they end, and how far they are."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace

import pytest
from toys import TEAR

from benchmarks.papers.machinery.process import Ended
from benchmarks.papers.machinery.runs import KILLED
from benchmarks.papers.machinery.task import CLOCK, DONE, TaskError
from cqrun.running.fleet import Member
from cqrun.store.atomic import write_json

RUN_ONCE = "benchmarks.papers.machinery.process._run_once"


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """The file of TEAR's scene, in a folder of its own."""
    monkeypatch.setattr("benchmarks.papers.machinery.runs.SCENES", tmp_path)
    file = tmp_path / "simulate" / "tear.yaml"
    file.parent.mkdir()
    return file


def ended(folder, status, name="0123456789ab"):
    """Write a run that has ended with a status."""
    run = folder / "tear" / name / "run.json"
    run.parent.mkdir(parents=True, exist_ok=True)
    run.write_text(json.dumps({"job": "simulate", "status": status, "reason": "", "seconds": 0.0, "files": {}}))


def answer(monkeypatch, *answers):
    """Answer every command with exit statuses and outputs, the last one again and again."""
    left = list(answers)
    monkeypatch.setattr(RUN_ONCE, lambda *_: Ended(*(left.pop(0) if len(left) > 1 else left[0]), 0.0))


def test_more_seeds_continue_and_comments_change_nothing(tmp_path, scene):
    scene.write_text("# a scene\nseed: 1\n")
    three = replace(TEAR, seeds=3)
    write_json(tmp_path / DONE, {"fingerprint": three.fingerprint(), "command": three.command, "seeds": 3})
    scene.write_text("# the same scene\nseed: 1  # as it was\n")
    assert three.done(tmp_path)["command"].endswith("--seeds 3")
    assert replace(three, seeds=2).done(tmp_path) is not None
    more = replace(three, seeds=4)
    assert more.done(tmp_path) is None
    assert more.fingerprint() == three.fingerprint()
    assert replace(three, overrides=()).done(tmp_path) is None
    scene.write_text("seed: 2\n")
    assert three.done(tmp_path) is None


def test_another_file_in_the_scene_makes_it_another_task(scene):
    (scene.parent / "shapes").mkdir()
    scene.write_text("bodies: {a: {shape: {mesh: {file: shapes/a.stl}}}}\n")
    fingerprints = [TEAR.fingerprint()]
    for content in ("solid", "solid too"):
        (scene.parent / "shapes" / "a.stl").write_text(content)
        fingerprints.append(TEAR.fingerprint())
    assert len(set(fingerprints)) == 3


def test_what_an_override_replaces_may_change_in_the_scene(scene):
    replaces, extends = (replace(TEAR, overrides=(f"optimizer{o}",)) for o in ("={adam: {}}", ".sgd.decay=1"))
    fingerprints = []
    for rate in (1, 2):
        scene.write_text(f"optimizer: {{sgd: {{learning_rate: {rate}}}}}\n")
        fingerprints.append((replaces.fingerprint(), extends.fingerprint()))
    assert fingerprints[0][0] == fingerprints[1][0]
    assert fingerprints[0][1] != fingerprints[1][1]


def test_a_run_is_a_command_that_a_reader_can_type(tmp_path):
    assert TEAR.command == "cqrun simulate scenes/simulate/tear.yaml -o time.duration=0.04 -o time.substeps=8"
    braces = replace(TEAR, overrides=("loads={}",))
    assert braces.command.endswith("-o 'loads={}'")
    assert TEAR.do(tmp_path / "tear", 100.0, 1)
    (run,) = TEAR.runs(tmp_path / "tear")
    assert (run / "observables.csv").exists()
    assert (tmp_path / "tear" / DONE).exists()


def test_seeds_and_variants_run_side_by_side(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(RUN_ONCE, lambda command, *_: commands.append(command) or Ended(0, "", 0.0))
    monkeypatch.setattr("benchmarks.papers.machinery.runs.cores", lambda threads: 4)
    for seeds, options, share in ((0, (), 1.0), (1, (), 0.5), (3, (), 1.0), (1, ("--ablate",), 1.0)):
        replace(TEAR, seeds=seeds, options=options).advance(tmp_path, 1.0, 2, share, "dask://login:8786")
    place = "dask://login:8786"
    for option, given in (
        ("--jobs", ["", "1", "2", "2"]),
        ("--threads", ["", "2", "", ""]),
        ("--on", ["", place, place, place]),
    ):
        assert [words[words.index(option) + 1] if option in words else "" for words in commands] == given


def test_bad_input_is_an_error_with_the_command(tmp_path):
    broken = replace(TEAR, overrides=("time.duration=-1",))
    with pytest.raises(TaskError, match=r"tear: `cqrun simulate .*` ended with 2\n(.|\n)*time.duration"):
        broken.do(tmp_path / "tear", 100.0, 1)


def test_a_run_that_another_process_has_is_waited_for(tmp_path, monkeypatch, capsys):
    """Its parent was killed, and it continues alone."""
    in_use = 1, "tear: another process works on this run (pid 7)"
    answer(monkeypatch, in_use, (0, ""))
    monkeypatch.setattr("benchmarks.papers.machinery.process.REPORT_EVERY", 0.0)
    assert TEAR.do(tmp_path / "tear", 100.0, 1)
    assert "waiting for it" in capsys.readouterr().out
    answer(monkeypatch, in_use)
    assert not TEAR.advance(tmp_path / "tear", 0.0, 1, 1.0)


def test_a_killed_run_is_not_finished(tmp_path, monkeypatch, capsys):
    answer(monkeypatch, (1, f"1 of 2 runs failed; was killed (SIGKILL); {KILLED}"), (1, "it blew up"))
    assert not TEAR.do(tmp_path / "tear", 100.0, 1)
    assert "was killed" in capsys.readouterr().out
    ended(tmp_path / "tear", "failed")
    assert TEAR.do(tmp_path / "tear", 100.0, 1)


def test_cqrun_says_of_a_killed_run_what_is_looked_for(tmp_path):
    member = Member("seed 0", tmp_path, [sys.executable, "-c", "import time; time.sleep(60)"], 1)
    member.start()
    member.process.kill()
    deadline = time.monotonic() + 60.0
    while not member.has_ended() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert KILLED in member.failure


def test_a_seed_that_never_began_is_missed(tmp_path, monkeypatch):
    """Its process ended before it had a record; the other seeds are no result without it."""
    answer(monkeypatch, (1, "the disk is full"))
    two = replace(TEAR, seeds=2)
    ended(tmp_path / "tear", "iteration_limit")
    with pytest.raises(TaskError, match="the disk is full"):
        two.advance(tmp_path / "tear", 100.0, 1, 1.0)
    ended(tmp_path / "tear", "iteration_limit", "ba9876543210")
    assert two.advance(tmp_path / "tear", 100.0, 1, 1.0)


@pytest.mark.parametrize("status", ["", "new", "running", "stopped"])
def test_a_run_that_ends_before_it_is_done_is_no_result(tmp_path, monkeypatch, status):
    """For example on a full disk: cqrun ends with 1 there, too."""
    answer(monkeypatch, (1, "no space left"))
    if status:
        ended(tmp_path / "tear", status)
    with pytest.raises(TaskError, match=r"ended with 1 before it was done\nno space left"):
        TEAR.advance(tmp_path / "tear", 100.0, 1, 1.0)


def test_progress_counts_runs_and_iterations(tmp_path):
    run = tmp_path / "tear" / "abc"
    run.mkdir(parents=True)
    (run / "run.json").write_text("{}")
    assert TEAR.progress(tmp_path) == "1 run begun"
    (run / "history.csv").write_text("iteration\n0\n1\n2\n")
    assert TEAR.progress(tmp_path) == "1 run begun, 2 iterations"


def test_the_time_left_of_several_runs_follows_their_own_pace(tmp_path):
    """Ten runs of 30 minutes as declared: two that ended in 40 minutes leave eight of 20 each."""
    task = replace(TEAR, seeds=5, variants=2, minutes=300.0)
    write_json(tmp_path / CLOCK, {"fingerprint": task.fingerprint(), "engine": "e", "seconds": 2400.0})
    for k, status in enumerate(("iteration_limit", "running", "failed")):
        assert task.left(tmp_path) == pytest.approx(260.0)
        ended(tmp_path, status, str(k))
    assert task.left(tmp_path) == pytest.approx(160.0)
    assert replace(task, seeds=1).left(tmp_path) == 0.0
    (tmp_path / "tear" / "0" / "run.json").write_text('{"sta')
    assert task.left(tmp_path) == pytest.approx(260.0)

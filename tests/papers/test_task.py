"""Tasks and measurements: they continue where they stopped, and start over when they have changed."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import pytest
from toys import COUNT

from benchmarks.papers.machinery.task import CLOCK, DONE, TaskError
from cqrun.store.atomic import write_json


def test_a_task_continues_where_it_stopped(tmp_path):
    folder = tmp_path / "count"
    assert [COUNT.do(folder, 1.0, 1) for _ in range(3)] == [False, False, True]
    facts = COUNT.done(folder)
    assert facts["command"] == "count to three"
    assert facts["seconds"] == COUNT.spent(folder) > 0


def test_the_time_of_a_stopped_task_counts(tmp_path):
    def stopped(folder, deadline):
        time.sleep(0.02)
        raise SystemExit(75)

    with pytest.raises(SystemExit):
        replace(COUNT, measure=stopped).do(tmp_path / "count", 1.0, 1)
    assert COUNT.spent(tmp_path / "count") >= 0.02


def test_most_of_the_time_of_a_killed_task_counts(tmp_path, monkeypatch):
    """The clock is written while the task runs, because a killed process cannot write it at the end."""
    seen = []

    def long(folder, deadline):
        time.sleep(0.2)
        seen.append(json.loads((folder / CLOCK).read_text())["seconds"])
        return True

    monkeypatch.setattr("benchmarks.papers.machinery.task.CLOCK_EVERY", 0.02)
    assert replace(COUNT, measure=long).do(tmp_path / "count", 1.0, 1)
    assert 0.1 < seen[0] <= COUNT.spent(tmp_path / "count")


def test_a_long_task_that_has_changed_is_set_aside(tmp_path, capsys):
    folder = tmp_path / "count"
    COUNT.do(folder, 1.0, 1)
    clock = json.loads((folder / CLOCK).read_text())
    write_json(folder / CLOCK, clock | {"seconds": 36_000.0})
    replace(COUNT, typed="count differently").do(folder, 1.0, 1)
    (aside,) = tmp_path.glob("count.was-*")
    assert str(aside) in capsys.readouterr().out
    assert (aside / "0.txt").exists()


def test_the_error_about_a_half_written_file_says_what_to_do(tmp_path):
    folder = tmp_path / "count"
    folder.mkdir()
    (folder / CLOCK).write_text('{"fingerp')
    with pytest.raises(TaskError, match=r"clock.json: damaged .*; delete .*count to start that task over"):
        COUNT.do(folder, 1.0, 1)


def test_a_task_that_has_changed_starts_over(tmp_path):
    folder = tmp_path / "count"
    while not COUNT.do(folder, 1.0, 1):
        pass
    other = replace(COUNT, typed="count differently")
    assert other.done(folder) is None
    assert (other.begun(folder), other.spent(folder)) == (False, 0.0)
    assert not other.do(folder, 1.0, 1)
    assert [file.name for file in folder.glob("*.txt")] == ["0.txt"]


def test_comments_in_its_scene_do_not_make_it_another_measurement(tmp_path):
    scene, data = tmp_path / "one.yaml", tmp_path / "one.csv"
    scene.write_text("# a scene\nseed: 1\n")
    data.write_text("# x\n1\n")
    counting = replace(COUNT, files=(scene, data))
    first = counting.fingerprint()
    scene.write_text("seed: 1  # the same\noptimizer: {adam: {}}\n")  # no measurement uses the optimizer
    assert counting.fingerprint() == first
    data.write_text("# y\n1\n")
    assert counting.fingerprint() != first
    data.write_text("# x\n1\n")
    assert replace(counting, settings=("coarse",)).fingerprint() != first
    scene.write_text("seed: 2\n")
    assert counting.fingerprint() != first


def test_a_measurement_continues_with_more_seeds(tmp_path):
    """What PPO has learned from one seed is not what it learns from three."""
    folder = tmp_path / "count"
    while not COUNT.do(folder, 1.0, 1):
        pass
    assert COUNT.done(folder) is not None
    more = replace(COUNT, seeds=2)
    assert more.done(folder) is None
    (folder / "2.txt").unlink()  # what the next seed writes
    assert more.do(folder, 1.0, 1)
    assert more.done(folder)["seeds"] == 2
    write_json(folder / DONE, {"fingerprint": more.fingerprint()})  # written before there were seeds
    assert more.done(folder) is not None


def test_results_of_two_engines_are_not_mixed(tmp_path, monkeypatch):
    assert not COUNT.do(tmp_path / "count", 9.0, 1)
    for module in ("task", "measurement"):
        monkeypatch.setattr(f"benchmarks.papers.machinery.{module}.engine_hash", lambda: "another")
    assert not COUNT.do(tmp_path / "count", 9.0, 1)
    assert [file.name for file in (tmp_path / "count").glob("*.txt")] == ["0.txt"]
    assert COUNT.engine(tmp_path / "count") == "another"

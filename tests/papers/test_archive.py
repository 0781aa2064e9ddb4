"""Long tasks continue on another machine, from the archives that are packed and committed."""

from __future__ import annotations

import json
import tarfile
from dataclasses import replace

import pytest

from benchmarks.papers.machinery.archive import archive_path, pack, unpack
from benchmarks.papers.machinery.process import ROOT
from benchmarks.papers.machinery.runs import SCENES, Runs
from benchmarks.papers.machinery.task import CLOCK, DONE, TaskError

SHORT = ("bodies.finger.sampling.lattice.count=5", "time.duration=0.05", "optimizer.sgd.max_iterations=2")
LEARNED = Runs("finger", 0.1, "control", "control/finger", SHORT, 2)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Two seeds, learned, and their archive."""
    runs = tmp_path_factory.mktemp("runs")
    assert LEARNED.do(runs / LEARNED.name, 300.0, 2)
    archive = archive_path(LEARNED, runs / "figures")
    pack(LEARNED, runs, archive)
    return runs, archive


def test_an_archive_is_small_and_names_no_path(learned):
    runs, archive = learned
    assert archive.stat().st_size < 50_000
    with tarfile.open(archive) as tar:
        names = tar.getnames()
        text = b"".join(tar.extractfile(name).read() for name in names if name.endswith((".json", ".yaml", ".csv")))
    assert {CLOCK, DONE} <= set(names)
    assert sum(name.endswith("history.csv") for name in names) == 2
    assert not [name for name in names if "trajectory" in name or name.endswith((".npz", ".log"))]  # finished: no state
    assert str(runs).encode() not in text
    assert str(ROOT).encode() not in text
    assert b"@SCENES@/control" in text


def test_it_continues_elsewhere_without_repeating_what_was_done(learned, tmp_path):
    runs, archive = learned
    assert unpack(LEARNED, tmp_path, archive)
    folder = tmp_path / LEARNED.name
    assert LEARNED.done(folder) == LEARNED.done(runs / LEARNED.name)
    bases = {json.loads(record.read_text())["base"] for record in folder.rglob("run.json")}
    assert bases == {str(SCENES / "control")}
    (folder / DONE).unlink()
    before = [path.read_bytes() for path in sorted(folder.rglob("history.csv"))]
    assert LEARNED.do(folder, 300.0, 2)
    assert [path.read_bytes() for path in sorted(folder.rglob("history.csv"))] == before
    assert not list(folder.rglob("trajectory.h5"))
    assert not unpack(LEARNED, tmp_path, archive)  # it is here


def test_a_state_is_packed_until_the_run_is_finished(learned, tmp_path):
    _, archive = learned
    unpack(LEARNED, tmp_path, archive)
    record = next((tmp_path / LEARNED.name).rglob("run.json"))
    for name in ("evals.0.npz", "evals.log"):
        (record.parent / name).write_bytes(b"state")
    record.write_text(json.dumps(json.loads(record.read_text()) | {"status": "stopped"}))
    pack(LEARNED, tmp_path, tmp_path / "again.tar.xz")
    with tarfile.open(tmp_path / "again.tar.xz") as tar:
        assert sum("evals." in name for name in tar.getnames()) == 2


def test_numbers_for_every_particle_of_a_finished_run_are_not_packed(learned, tmp_path):
    _, archive = learned
    unpack(LEARNED, tmp_path, archive)
    found, stopped = sorted((tmp_path / LEARNED.name).rglob("result.json"))
    entry = {"initial": 1.0, "value": [0.1] * 5_000, "at_bounds": 3}
    for result in (found, stopped):
        result.write_text(json.dumps(json.loads(result.read_text()) | {"unknowns": {"stiffness": entry}}))
    record = stopped.parent / "run.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"status": "stopped"}))
    pack(LEARNED, tmp_path, tmp_path / "again.tar.xz")
    with tarfile.open(tmp_path / "again.tar.xz") as tar:
        packed_of = {
            name.split("/")[-2]: json.loads(tar.extractfile(name).read())["unknowns"]["stiffness"]
            for name in tar.getnames()
            if name.endswith("result.json")
        }
    assert packed_of[found.parent.name] == {"initial": 1.0, "at_bounds": 3}
    assert packed_of[stopped.parent.name] == entry


def test_the_archive_of_a_changed_task_or_of_another_engine_is_not_unpacked(learned, tmp_path, monkeypatch):
    runs, archive = learned
    changed = replace(LEARNED, overrides=(*SHORT, "time.substeps=2"))
    assert not unpack(changed, tmp_path, archive)
    unfinished = tmp_path / "unfinished.tar.xz"
    done = runs / LEARNED.name / DONE
    text = done.read_text()
    done.unlink()
    pack(LEARNED, runs, unfinished)
    done.write_text(text)
    monkeypatch.setattr("benchmarks.papers.machinery.archive.engine_hash", lambda: "another")
    assert not unpack(LEARNED, tmp_path, unfinished)
    assert unpack(LEARNED, tmp_path, archive)  # finished


def test_the_archive_of_a_changed_task_is_reported_and_set_aside(learned, tmp_path, capsys):
    """Nobody else may have the hours of work in it."""
    _, archive = learned
    runs, rich = tmp_path / "runs", tmp_path / "finger.tar.xz"
    unpack(LEARNED, runs, archive)
    clock = runs / LEARNED.name / CLOCK
    clock.write_text(json.dumps(json.loads(clock.read_text()) | {"seconds": 36_000.0}))
    pack(LEARNED, runs, rich)
    packed = rich.read_bytes()
    changed = replace(LEARNED, overrides=(*SHORT, "time.substeps=2"))
    other = tmp_path / "other"
    assert not unpack(changed, other, rich)
    assert "finger.tar.xz is not used: finger has changed since" in capsys.readouterr().out
    assert changed.do(other / LEARNED.name, 300.0, 2)
    pack(changed, other, rich)
    (aside,) = tmp_path.glob("finger.was-*.tar.xz")
    assert aside.read_bytes() == packed
    assert rich.read_bytes() != packed
    assert str(aside) in capsys.readouterr().out


def test_an_archive_that_holds_more_stays(learned, tmp_path, monkeypatch, capsys):
    """An archive with hours of work by another engine was once replaced by one with a second of work by this one."""
    _, archive = learned
    runs, rich = tmp_path / "runs", tmp_path / "rich.tar.xz"
    unpack(LEARNED, runs, archive)
    clock = runs / LEARNED.name / CLOCK
    facts = json.loads(clock.read_text())
    clock.write_text(json.dumps(facts | {"seconds": 36_000.0}))
    (runs / LEARNED.name / DONE).unlink()
    pack(LEARNED, runs, rich)
    packed = rich.read_bytes()
    clock.write_text(json.dumps(facts | {"seconds": 1.0}))
    pack(LEARNED, runs, rich)
    assert "stays: it holds more of finger" in capsys.readouterr().out
    assert rich.read_bytes() == packed
    (runs / LEARNED.name / DONE).write_text(json.dumps(facts | {"seeds": LEARNED.seeds}))  # all is more than much
    pack(LEARNED, runs, tmp_path / "whole.tar.xz")
    whole = (tmp_path / "whole.tar.xz").read_bytes()
    (runs / LEARNED.name / DONE).unlink()
    clock.write_text(json.dumps(facts | {"seconds": 36_000.0}))
    pack(LEARNED, runs, tmp_path / "whole.tar.xz")
    assert (tmp_path / "whole.tar.xz").read_bytes() == whole
    monkeypatch.setattr("benchmarks.papers.machinery.archive.engine_hash", lambda: "another")
    with pytest.raises(TaskError, match="600 minutes of work by engine"):
        unpack(LEARNED, tmp_path / "elsewhere", rich)
    rich.write_bytes(packed[:1000])
    with pytest.raises(TaskError, match="damaged"):
        unpack(LEARNED, tmp_path / "elsewhere", rich)


@pytest.mark.slow
def test_minutes_of_another_engine_are_not_deleted(learned, tmp_path):
    _, archive = learned
    unpack(LEARNED, tmp_path, archive)
    folder = tmp_path / LEARNED.name
    (folder / DONE).unlink()
    for record in folder.rglob("run.json"):
        facts = json.loads(record.read_text())
        record.write_text(json.dumps(facts | {"engine": "another", "status": "stopped"}))
    clock = json.loads((folder / CLOCK).read_text()) | {"engine": "another", "seconds": 4000.0}
    (folder / CLOCK).write_text(json.dumps(clock))
    with pytest.raises(TaskError, match="67 minutes of work by engine another"):
        LEARNED.do(folder, 300.0, 2)
    (folder / CLOCK).write_text(json.dumps(clock | {"seconds": 4.0}))
    assert LEARNED.do(folder, 300.0, 2)
    assert list(folder.rglob("trajectory.h5"))  # learned again

"""Long work goes on on another machine, from what was packed and committed."""

from __future__ import annotations

import json
import tarfile
from dataclasses import replace

import pytest

from benchmarks.papers.machinery import archive as kept
from benchmarks.papers.machinery import work
from benchmarks.papers.machinery.archive import archive_of, keep, restore
from benchmarks.papers.machinery.work import CLOCK, DONE, Runs, WorkError

SHORT = ("bodies.finger.sampling.lattice.count=5", "time.duration=0.05", "optimizer.sgd.max_iterations=2")
LEARNED = Runs("finger", 0.1, "control", "control/finger", SHORT, 2)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Two seeds, learned, and their archive."""
    runs = tmp_path_factory.mktemp("runs")
    assert LEARNED.do(runs / LEARNED.name, 300.0, 2)
    archive = archive_of(LEARNED, runs / "figures")
    keep(LEARNED, runs, archive)
    return runs, archive


def test_an_archive_is_small_and_names_no_path(learned):
    runs, archive = learned
    assert archive.stat().st_size < 50_000
    with tarfile.open(archive) as tar:
        names = tar.getnames()
        said = b"".join(tar.extractfile(name).read() for name in names if name.endswith((".json", ".yaml", ".csv")))
    assert {CLOCK, DONE} <= set(names)
    assert sum(name.endswith("history.csv") for name in names) == 2
    assert not [name for name in names if "trajectory" in name or name.endswith((".npz", ".log"))]  # finished: no state
    assert str(runs).encode() not in said
    assert str(work.ROOT).encode() not in said
    assert b"@SCENES@/control" in said


def test_it_goes_on_elsewhere_without_doing_again_what_was_done(learned, tmp_path):
    runs, archive = learned
    assert restore(LEARNED, tmp_path, archive)
    folder = tmp_path / LEARNED.name
    assert LEARNED.done(folder) == LEARNED.done(runs / LEARNED.name)
    bases = {json.loads(record.read_text())["base"] for record in folder.rglob("run.json")}
    assert bases == {str(work.SCENES / "control")}
    (folder / DONE).unlink()
    before = [path.read_bytes() for path in sorted(folder.rglob("history.csv"))]
    assert LEARNED.do(folder, 300.0, 2)
    assert [path.read_bytes() for path in sorted(folder.rglob("history.csv"))] == before
    assert not list(folder.rglob("trajectory.h5"))
    assert not restore(LEARNED, tmp_path, archive)  # it is here


def test_a_state_is_kept_until_the_run_is_finished(learned, tmp_path):
    _, archive = learned
    restore(LEARNED, tmp_path, archive)
    record = next((tmp_path / LEARNED.name).rglob("run.json"))
    for name in ("evals.0.npz", "evals.log"):
        (record.parent / name).write_bytes(b"state")
    record.write_text(json.dumps(json.loads(record.read_text()) | {"status": "stopped"}))
    keep(LEARNED, tmp_path, tmp_path / "again.tar.xz")
    with tarfile.open(tmp_path / "again.tar.xz") as tar:
        assert sum("evals." in name for name in tar.getnames()) == 2


def test_what_was_found_for_every_particle_is_not_kept_of_a_finished_run(learned, tmp_path):
    _, archive = learned
    restore(LEARNED, tmp_path, archive)
    found, stopped = sorted((tmp_path / LEARNED.name).rglob("result.json"))
    entry = {"initial": 1.0, "value": [0.1] * 5_000, "at_bounds": 3}
    for result in (found, stopped):
        result.write_text(json.dumps(json.loads(result.read_text()) | {"unknowns": {"stiffness": entry}}))
    record = stopped.parent / "run.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"status": "stopped"}))
    keep(LEARNED, tmp_path, tmp_path / "again.tar.xz")
    with tarfile.open(tmp_path / "again.tar.xz") as tar:
        kept_of = {
            name.split("/")[-2]: json.loads(tar.extractfile(name).read())["unknowns"]["stiffness"]
            for name in tar.getnames()
            if name.endswith("result.json")
        }
    assert kept_of[found.parent.name] == {"initial": 1.0, "at_bounds": 3}
    assert kept_of[stopped.parent.name] == entry


def test_work_that_has_changed_or_is_another_engines_is_not_taken(learned, tmp_path, monkeypatch):
    runs, archive = learned
    changed = replace(LEARNED, overrides=(*SHORT, "time.substeps=2"))
    assert not restore(changed, tmp_path, archive)
    unfinished = tmp_path / "unfinished.tar.xz"
    done = runs / LEARNED.name / DONE
    text = done.read_text()
    done.unlink()
    keep(LEARNED, runs, unfinished)
    done.write_text(text)
    monkeypatch.setattr(kept, "engine_hash", lambda: "another")
    assert not restore(LEARNED, tmp_path, unfinished)
    assert restore(LEARNED, tmp_path, archive)  # finished


def test_an_archive_of_other_work_is_told_of_and_put_aside(learned, tmp_path, capsys):
    """Hours of it may be all that there is."""
    _, archive = learned
    runs, rich = tmp_path / "runs", tmp_path / "finger.tar.xz"
    restore(LEARNED, runs, archive)
    clock = runs / LEARNED.name / CLOCK
    clock.write_text(json.dumps(json.loads(clock.read_text()) | {"seconds": 36_000.0}))
    keep(LEARNED, runs, rich)
    packed = rich.read_bytes()
    changed = replace(LEARNED, overrides=(*SHORT, "time.substeps=2"))
    other = tmp_path / "other"
    assert not restore(changed, other, rich)
    assert "finger.tar.xz is of what finger was before it changed, and is not taken up" in capsys.readouterr().out
    assert changed.do(other / LEARNED.name, 300.0, 2)
    keep(changed, other, rich)
    (aside,) = tmp_path.glob("finger.was-*.tar.xz")
    assert aside.read_bytes() == packed
    assert rich.read_bytes() != packed
    assert str(aside) in capsys.readouterr().out


def test_an_archive_that_holds_more_stays(learned, tmp_path, monkeypatch, capsys):
    """Hours of another machine, by another engine, were once written over by a second of this one's."""
    _, archive = learned
    runs, rich = tmp_path / "runs", tmp_path / "rich.tar.xz"
    restore(LEARNED, runs, archive)
    clock = runs / LEARNED.name / CLOCK
    facts = json.loads(clock.read_text())
    clock.write_text(json.dumps(facts | {"seconds": 36_000.0}))
    (runs / LEARNED.name / DONE).unlink()
    keep(LEARNED, runs, rich)
    packed = rich.read_bytes()
    clock.write_text(json.dumps(facts | {"seconds": 1.0}))
    keep(LEARNED, runs, rich)
    assert "and stays" in capsys.readouterr().out
    assert rich.read_bytes() == packed
    (runs / LEARNED.name / DONE).write_text(json.dumps(facts | {"seeds": LEARNED.seeds}))  # all is more than much
    keep(LEARNED, runs, tmp_path / "whole.tar.xz")
    whole = (tmp_path / "whole.tar.xz").read_bytes()
    (runs / LEARNED.name / DONE).unlink()
    clock.write_text(json.dumps(facts | {"seconds": 36_000.0}))
    keep(LEARNED, runs, tmp_path / "whole.tar.xz")
    assert (tmp_path / "whole.tar.xz").read_bytes() == whole
    monkeypatch.setattr(kept, "engine_hash", lambda: "another")
    with pytest.raises(WorkError, match="600 minutes of work by engine"):
        restore(LEARNED, tmp_path / "elsewhere", rich)
    rich.write_bytes(packed[:1000])
    with pytest.raises(WorkError, match="cannot be read"):
        restore(LEARNED, tmp_path / "elsewhere", rich)


def test_minutes_of_another_engine_are_not_thrown_away(learned, tmp_path):
    _, archive = learned
    restore(LEARNED, tmp_path, archive)
    folder = tmp_path / LEARNED.name
    (folder / DONE).unlink()
    for record in folder.rglob("run.json"):
        facts = json.loads(record.read_text())
        record.write_text(json.dumps(facts | {"engine": "another", "status": "stopped"}))
    clock = json.loads((folder / CLOCK).read_text()) | {"engine": "another", "seconds": 4000.0}
    (folder / CLOCK).write_text(json.dumps(clock))
    with pytest.raises(WorkError, match="67 minutes of work by engine another"):
        LEARNED.do(folder, 300.0, 2)
    (folder / CLOCK).write_text(json.dumps(clock | {"seconds": 4.0}))
    assert LEARNED.do(folder, 300.0, 2)
    assert list(folder.rglob("trajectory.h5"))  # learned again

"""What is published of a figure: as much as there is, with a verdict that follows from it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from toys import COUNT, TEAR, Toy

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import Judgement, Size, Verdict, read_table
from benchmarks.papers.machinery.process import ROOT
from benchmarks.papers.machinery.publish import Publication, Record, TaskRecord
from benchmarks.papers.machinery.task import TaskError
from cqrun.fingerprint import engine_hash

PUBLISHED = ROOT / "results" / "figures"


def record_of(task, *failed):
    """Return the record of a figure whose only task is done."""
    published = TaskRecord(command=task.command, fingerprint=task.fingerprint(), minutes=1.0)
    return Record(done=(1, 1), failed=failed, works={task.name: published}, engine=[], machines=[])


def test_an_unfinished_figure_shows_what_there_is(tmp_path):
    toy = Publication(Toy(COUNT), Size.QUICK, tmp_path / "out")
    assert toy.publish(tmp_path) is None
    COUNT.do(tmp_path / "count", 1.0, 1)
    COUNT.do(tmp_path / "count", 1.0, 1)
    assert toy.publish(tmp_path).judgement == Judgement.UNFINISHED
    COUNT.do(tmp_path / "count", 1.0, 1)
    assert str(toy.publish(tmp_path)) == "reproduced: they grow (yes); there are three (yes)"
    assert sorted(path.suffix for path in (tmp_path / "out" / "quick").iterdir()) == [".csv", ".json", ".pdf", ".png"]


def test_a_published_figure_is_drawn_and_judged_again(tmp_path):
    toy = Publication(Toy(COUNT), Size.QUICK, tmp_path / "out")
    assert toy.judge_again() is None
    COUNT.do(tmp_path / "count", 1.0, 1)
    assert toy.publish(tmp_path).judgement is Judgement.UNFINISHED
    record, picture = toy.file(".json"), toy.file(".png")
    before, drawn = json.loads(record.read_text()), picture.read_bytes()
    record.write_text(json.dumps(before | {"checks": {"by an older rule": False}}))
    picture.unlink()
    assert toy.judge_again().judgement is Judgement.UNFINISHED
    assert json.loads(record.read_text()) == before
    assert picture.read_bytes() == drawn
    assert before["engine"] == [engine_hash()]  # also of a task that has only begun


def test_other_numbers_than_were_published_are_not_judged(tmp_path):
    toy = Publication(Toy(COUNT), Size.QUICK, tmp_path / "out")
    COUNT.do(tmp_path / "count", 1.0, 1)
    toy.publish(tmp_path)
    record, data = toy.file(".json"), toy.file(".csv")
    data.write_text(data.read_text()[:8])
    expected = r"toy.csv: not the numbers that were published; restore it from git, or run `python"
    with pytest.raises(TaskError, match=expected):
        toy.judge_again()
    record.write_text(record.read_text()[:50])
    with pytest.raises(TaskError, match=r"toy.json: damaged: Invalid JSON"):
        toy.judge_again()


def test_a_verdict_follows_from_its_checks():
    assert Verdict.of({"a": True, "b": True}).judgement is Judgement.MET
    assert Verdict.of({"a": True, "b": False}).judgement is Judgement.PARTLY
    assert Verdict.of({"a": False}).judgement is Judgement.MISSED
    assert Verdict.of({}).judgement is Judgement.MISSED


def test_a_figure_whose_runs_failed_or_whose_task_has_changed_is_not_reproduced(tmp_path):
    toy, table = Publication(Toy(COUNT), Size.QUICK, tmp_path), {"k": np.arange(3.0)}
    assert toy.verdict(table, record_of(COUNT)).judgement is Judgement.MET
    missed = toy.verdict({"k": np.zeros(2)}, record_of(COUNT, "it blew up"))
    assert missed.judgement is Judgement.MISSED  # a failure makes nothing better
    failed = toy.verdict(table, record_of(COUNT, "it blew up"))
    assert failed.judgement is Judgement.PARTLY
    assert failed.checks["no run fails (1 failed: it blew up)"] is False
    for changed in (replace(COUNT, typed="count to two"), replace(COUNT, settings=("slowly",))):
        assert toy.verdict(table, record_of(changed)).judgement is Judgement.UNFINISHED


def test_failed_runs_are_counted(tmp_path):
    blown = replace(TEAR, overrides=("time.duration=0.2", "boundaries={}", "bodies.bar.velocity=[-9, 0]"))
    assert blown.do(tmp_path / "tear", 100.0, 1)
    (reason,) = blown.failures(tmp_path / "tear")
    assert "bar" in reason


@pytest.mark.parametrize("file", sorted(PUBLISHED.glob("*/*.json")), ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_the_committed_verdicts_follow_from_the_committed_numbers(file):
    """By today's rules."""
    committed = Publication(FIGURES[file.stem], Size(file.parent.name), PUBLISHED)
    record, _ = committed.verified()  # raises an error if the CSV has changed
    verdict = committed.verdict(read_table(file.with_suffix(".csv")), record)
    assert (verdict.judgement, dict(verdict.checks)) == (record.verdict, record.checks)
    assert record.asked == committed.figure.criteria[committed.size]
    for suffix in (".png", ".pdf"):
        assert file.with_suffix(suffix).stat().st_size > 1000

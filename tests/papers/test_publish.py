"""What is published of a figure: as much as there is, with a verdict that follows from it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from toys import COUNT, TEAR, Toy

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import Judgement, Size, judged, read_table
from benchmarks.papers.machinery.publish import _digest, identity, publish, publish_again, verdict_on
from benchmarks.papers.machinery.work import ROOT, WorkError
from cqrun.fingerprint import engine_hash

PUBLISHED = ROOT / "results" / "figures"


def test_an_unfinished_figure_shows_what_there_is(tmp_path):
    toy = Toy(COUNT)
    assert publish(toy, Size.QUICK, tmp_path, tmp_path / "out") is None
    COUNT.do(tmp_path / "count", 1.0, 1)
    COUNT.do(tmp_path / "count", 1.0, 1)
    verdict = publish(toy, Size.QUICK, tmp_path, tmp_path / "out")
    assert verdict.judgement == Judgement.UNFINISHED
    COUNT.do(tmp_path / "count", 1.0, 1)
    verdict = publish(toy, Size.QUICK, tmp_path, tmp_path / "out")
    assert str(verdict) == "reproduced: they grow (yes); there are three (yes)"
    assert sorted(path.suffix for path in (tmp_path / "out" / "quick").iterdir()) == [".csv", ".json", ".pdf", ".png"]


def test_what_was_published_is_drawn_and_judged_anew(tmp_path):
    toy, out = Toy(COUNT), tmp_path / "out"
    assert publish_again(toy, Size.QUICK, out) is None
    COUNT.do(tmp_path / "count", 1.0, 1)
    assert publish(toy, Size.QUICK, tmp_path, out).judgement is Judgement.UNFINISHED
    record, picture = out / "quick" / "toy.json", out / "quick" / "toy.png"
    before, drawn = json.loads(record.read_text()), picture.read_bytes()
    record.write_text(json.dumps(before | {"checks": {"by an older rule": False}}))
    picture.unlink()
    assert publish_again(toy, Size.QUICK, out).judgement is Judgement.UNFINISHED
    assert json.loads(record.read_text()) == before
    assert picture.read_bytes() == drawn
    assert before["engine"] == [engine_hash()]  # of what is begun, too


def test_other_numbers_than_were_published_are_not_judged(tmp_path):
    toy, out = Toy(COUNT), tmp_path / "out"
    COUNT.do(tmp_path / "count", 1.0, 1)
    publish(toy, Size.QUICK, tmp_path, out)
    record, data = out / "quick" / "toy.json", out / "quick" / "toy.csv"
    data.write_text(data.read_text()[:8])
    with pytest.raises(WorkError, match=r"toy.csv: not the numbers that were published; get it back, or run `python"):
        publish_again(toy, Size.QUICK, out)
    record.write_text(record.read_text()[:50])
    with pytest.raises(WorkError, match=r"toy.json: not JSON"):
        publish_again(toy, Size.QUICK, out)


def test_a_verdict_is_what_its_checks_come_to():
    assert judged({"a": True, "b": True}).judgement is Judgement.MET
    assert judged({"a": True, "b": False}).judgement is Judgement.PARTLY
    assert judged({"a": False}).judgement is Judgement.MISSED
    assert judged({}).judgement is Judgement.MISSED


def test_what_fails_or_has_changed_is_not_reproduced(tmp_path):
    toy, table = Toy(COUNT), {"k": np.arange(3.0)}
    record = {"done": [1, 1], "failed": [], "works": identity([COUNT])}
    assert verdict_on(toy, table, Size.QUICK, record).judgement is Judgement.MET
    missed = verdict_on(toy, {"k": np.zeros(2)}, Size.QUICK, record | {"failed": ["it blew up"]})
    assert missed.judgement is Judgement.MISSED  # a failure makes nothing better
    failed = verdict_on(toy, table, Size.QUICK, record | {"failed": ["it blew up"]})
    assert failed.judgement is Judgement.PARTLY
    assert failed.checks["no run fails (1 did: it blew up)"] is False
    for changed in (replace(COUNT, told="count to two"), replace(COUNT, settings=("slowly",))):
        other = record | {"works": identity([changed])}
        assert verdict_on(toy, table, Size.QUICK, other).judgement is Judgement.UNFINISHED


def test_failed_runs_are_counted(tmp_path):
    blown = replace(TEAR, overrides=("time.duration=0.2", "boundaries={}", "bodies.bar.velocity=[-9, 0]"))
    assert blown.do(tmp_path / "tear", 100.0, 1)
    (reason,) = blown.failures(tmp_path / "tear")
    assert "bar" in reason


@pytest.mark.parametrize("record", sorted(PUBLISHED.glob("*/*.json")), ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_what_is_committed_is_what_is_judged(record):
    """The verdict follows from the committed numbers, by today's rules."""
    told = json.loads(record.read_text())
    assert _digest(record.with_suffix(".csv")) == told["data"]
    table, size = read_table(record.with_suffix(".csv")), Size(record.parent.name)
    verdict = verdict_on(FIGURES[record.stem], table, size, told)
    assert (verdict.judgement, dict(verdict.checks)) == (told["verdict"], told["checks"])
    assert told["asked"] == FIGURES[record.stem].tolerance[size]
    for suffix in (".png", ".pdf"):
        assert record.with_suffix(suffix).stat().st_size > 1000

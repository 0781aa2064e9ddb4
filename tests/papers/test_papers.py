"""`make reproduce-figures`: the catalogue, how its work goes on, what is published, and the page."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.papers import __main__ as command
from benchmarks.papers.ablations import ORDER, Ablation
from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import Figure, Judgement, Size, judged, read_table, stacked, write_table
from benchmarks.papers.histories import Run, curves, first_below, settled, smooth
from benchmarks.papers.learning import Distances
from benchmarks.papers.page import write_page
from benchmarks.papers.publish import _digest, identity, publish, publish_again, verdict_on
from benchmarks.papers.work import CLOCK, DONE, ROOT, STOPPED, Measurement, Runs, WorkError, _for_so_long
from cqrun.figures.style import new_figure, styled
from cqrun.fingerprint import engine_hash
from cqrun.scene.build import build
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json

PUBLISHED = ROOT / "results" / "figures"
QUICK_MINUTES = 60.0
"""The quick set takes no longer on two cores."""

TEAR = Runs("tear", 0.1, "simulate", "simulate/tear", ("time.duration=0.04", "time.substeps=8"))

WORKS = {
    (figure.id, size, work.name): work for figure in FIGURES.values() for size in Size for work in figure.work(size)
}


class Toy(Figure):
    """Three numbers, one after the other."""

    id, title, source, paper = "toy", "three numbers", "nowhere", "1 2 3"
    tolerance = dict.fromkeys(Size, "they grow")

    def __init__(self, *works):
        self.works = works

    def work(self, size):
        return self.works

    def table(self, found, size):
        files = sorted(file for folder in found.values() for file in folder.glob("*.txt"))
        return stacked({"k": float(file.stem), "label": file.read_text()} for file in files)

    def draw(self, table, size, found):
        picture = new_figure(2.0, 2.0)
        picture.add_subplot().plot(table["k"])
        return picture

    def judge(self, table, size):
        return judged({"they grow": bool(np.all(np.diff(table["k"]) > 0)), "there are three": len(table["k"]) == 3})


def counting(folder: Path, deadline: float) -> bool:
    """Write the next of three files; say whether all are there."""
    k = len(list(folder.glob("*.txt")))
    (folder / f"{k}.txt").write_text("odd" if k % 2 else "even")
    return k == 2


COUNT = Measurement("count", 1.0, counting, "count to three")


# --- the catalogue ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("figure", FIGURES.values(), ids=list(FIGURES))
def test_a_figure_says_what_it_is(figure):
    for text in (figure.title, figure.source, figure.paper, *figure.tolerance.values()):
        assert text.strip()
    assert set(figure.tolerance) == set(Size)
    assert all(work.minutes > 0 for size in Size for work in figure.work(size))


@pytest.mark.parametrize(
    "work", [w for w in WORKS.values() if isinstance(w, Runs)], ids=lambda w: f"{w.name}-{w.fingerprint()[:6]}"
)
def test_what_is_run_can_be_built_and_is_stable(work):
    """A figure at quick size once asked for substeps at which its hills blow up."""
    scene = load_scene(work.path, list(work.overrides))
    assert scene.job == work.job or (scene.job, work.job) == ("codesign", "control")
    assert build(scene).model.n_steps > 0


@pytest.mark.parametrize(
    "work",
    [w for (i, size, _), w in WORKS.items() if isinstance(w, Runs) and size is Size.QUICK and i != "cq2_fracture"],
    ids=lambda w: f"{w.name}-{w.fingerprint()[:6]}",
)
def test_quick_bodies_have_particles_enough_to_hold_together(work):
    """A quick biped once came apart as it walked, and was called reproduced for how far its head flew."""
    warnings = [str(warning) for warning in build(load_scene(work.path, list(work.overrides))).warnings]
    assert not [warning for warning in warnings if "a body may break apart" in warning]


@pytest.mark.parametrize("size", Size)
@pytest.mark.parametrize("figure", FIGURES.values(), ids=list(FIGURES))
def test_work_that_is_hardly_begun_shows_nothing_and_ends_nothing(figure, size, tmp_path):
    """`make reproduce-figures MINUTES=1` once ended in a traceback, and without the figures after it."""
    for work in figure.work(size):
        (tmp_path / work.name).mkdir()
        write_json(tmp_path / work.name / CLOCK, {"fingerprint": work.fingerprint(), "engine": "none", "seconds": 1.0})
    verdict = publish(figure, size, tmp_path, tmp_path / "out")
    assert verdict is None or verdict.judgement is Judgement.UNFINISHED


def test_work_of_one_name_is_one_work():
    commands = defaultdict(set)
    for (_, size, name), work in WORKS.items():
        commands[size, name].add(work.command)
    assert [names for names, told in commands.items() if len(told) > 1] == []


def test_the_quick_set_is_quick():
    works = {work.name: work.minutes for (_, size, _), work in WORKS.items() if size is Size.QUICK}
    assert sum(works.values()) <= QUICK_MINUTES


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


def test_a_seed_that_goes_on_is_left_out_beside_one_that_is_done():
    runs = [Run(Path(), seed, {}, finished) for seed, finished in ((0, True), (1, False))]
    assert [run.seed for run in settled(runs)] == [0]
    assert settled(runs[1:]) == runs[1:]


# --- work ---------------------------------------------------------------------------------------------------------


def test_work_goes_on_where_it_stopped(tmp_path):
    folder = tmp_path / "count"
    assert [COUNT.do(folder, 1.0, 1) for _ in range(3)] == [False, False, True]
    facts = COUNT.done(folder)
    assert facts["command"] == "count to three"
    assert facts["seconds"] == COUNT.spent(folder) > 0


def test_work_that_is_stopped_has_its_time(tmp_path):
    def stopped(folder, deadline):
        time.sleep(0.02)
        raise SystemExit(75)

    with pytest.raises(SystemExit):
        replace(COUNT, measure=stopped).do(tmp_path / "count", 1.0, 1)
    assert COUNT.spent(tmp_path / "count") >= 0.02


def test_work_that_is_killed_has_most_of_its_time(tmp_path, monkeypatch):
    """The clock is written while work goes on, for who is killed writes nothing in the end."""
    seen = []

    def long(folder, deadline):
        time.sleep(0.2)
        seen.append(json.loads((folder / CLOCK).read_text())["seconds"])
        return True

    monkeypatch.setattr("benchmarks.papers.work.TICK", 0.02)
    assert replace(COUNT, measure=long).do(tmp_path / "count", 1.0, 1)
    assert 0.1 < seen[0] <= COUNT.spent(tmp_path / "count")


def test_long_work_that_has_changed_is_put_aside(tmp_path, capsys):
    folder = tmp_path / "count"
    COUNT.do(folder, 1.0, 1)
    clock = json.loads((folder / CLOCK).read_text())
    write_json(folder / CLOCK, clock | {"seconds": 36_000.0})
    replace(COUNT, told="count differently").do(folder, 1.0, 1)
    (aside,) = tmp_path.glob("count.was-*")
    assert str(aside) in capsys.readouterr().out
    assert (aside / "0.txt").exists()


def test_what_was_half_written_says_what_to_do(tmp_path):
    folder = tmp_path / "count"
    folder.mkdir()
    (folder / CLOCK).write_text('{"fingerp')
    with pytest.raises(WorkError, match=r"clock.json: not JSON .*; delete .*count to start that over"):
        COUNT.do(folder, 1.0, 1)


def test_work_that_has_changed_is_done_anew(tmp_path):
    folder = tmp_path / "count"
    while not COUNT.do(folder, 1.0, 1):
        pass
    other = replace(COUNT, told="count differently")
    assert other.done(folder) is None
    assert (other.begun(folder), other.spent(folder)) == (False, 0.0)
    assert not other.do(folder, 1.0, 1)
    assert [file.name for file in folder.glob("*.txt")] == ["0.txt"]


def test_more_seeds_go_on_and_comments_change_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.papers.work.SCENES", tmp_path)
    scene = tmp_path / "simulate" / "tear.yaml"
    scene.parent.mkdir()
    scene.write_text("# a scene\nseed: 1\n")
    three = replace(TEAR, seeds=3)
    write_json(tmp_path / DONE, {"fingerprint": three.fingerprint(), **three.facts()})
    scene.write_text("# the same scene\nseed: 1  # as it was\n")
    assert three.done(tmp_path)["command"].endswith("--seeds 3")
    assert replace(three, seeds=2).done(tmp_path) is not None
    more = replace(three, seeds=4)
    assert more.done(tmp_path) is None
    assert more.fingerprint() == three.fingerprint()
    assert replace(three, overrides=()).done(tmp_path) is None
    scene.write_text("seed: 2\n")
    assert three.done(tmp_path) is None


def test_a_file_that_a_scene_names_makes_it_other_work(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.papers.work.SCENES", tmp_path)
    scene = tmp_path / "simulate" / "tear.yaml"
    (scene.parent / "shapes").mkdir(parents=True)
    scene.write_text("bodies: {a: {shape: {mesh: {file: shapes/a.stl}}}}\n")
    image = scene.parent / "shapes" / "a.stl"
    found = [TEAR.fingerprint()]
    for said in ("solid", "solid too"):
        image.write_text(said)
        found.append(TEAR.fingerprint())
    assert len(set(found)) == 3


def test_what_an_override_replaces_may_change_in_the_scene(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.papers.work.SCENES", tmp_path)
    scene = tmp_path / "simulate" / "tear.yaml"
    scene.parent.mkdir()
    replaces, extends = (replace(TEAR, overrides=(f"optimizer{o}",)) for o in ("={adam: {}}", ".sgd.decay=1"))
    found = []
    for rate in (1, 2):
        scene.write_text(f"optimizer: {{sgd: {{learning_rate: {rate}}}}}\n")
        found.append((replaces.fingerprint(), extends.fingerprint()))
    assert found[0][0] == found[1][0]
    assert found[0][1] != found[1][1]


def test_comments_in_its_scene_do_not_make_it_another_measurement(tmp_path):
    scene, data = tmp_path / "one.yaml", tmp_path / "one.csv"
    scene.write_text("# a scene\nseed: 1\n")
    data.write_text("# x\n1\n")
    counting = replace(COUNT, sources=(scene, data))
    first = counting.fingerprint()
    scene.write_text("seed: 1  # the same\noptimizer: {adam: {}}\n")  # which nothing that is measured uses
    assert counting.fingerprint() == first
    data.write_text("# y\n1\n")
    assert counting.fingerprint() != first
    data.write_text("# x\n1\n")
    assert replace(counting, settings=("coarse",)).fingerprint() != first
    scene.write_text("seed: 2\n")
    assert counting.fingerprint() != first


def test_a_run_is_a_command_that_a_reader_can_type(tmp_path):
    assert TEAR.command == "cqrun simulate scenes/simulate/tear.yaml -o time.duration=0.04 -o time.substeps=8"
    braces = replace(TEAR, overrides=("loads={}",))
    assert braces.command.endswith("-o 'loads={}'")
    assert TEAR.do(tmp_path / "tear", 100.0, 1)
    (run,) = TEAR.runs(tmp_path / "tear")
    assert (run / "observables.csv").exists()
    assert (tmp_path / "tear" / DONE).exists()


def test_a_run_that_cannot_be_ends_with_its_command(tmp_path):
    broken = replace(TEAR, overrides=("time.duration=-1",))
    with pytest.raises(WorkError, match=r"tear: `cqrun simulate .*` ended with 2\n(.|\n)*time.duration"):
        broken.do(tmp_path / "tear", 100.0, 1)


def test_a_run_that_another_process_holds_is_waited_for(tmp_path, monkeypatch, capsys):
    """Whoever began it was killed, and it goes on alone."""
    answers = [(1, "tear: another process works on this run (pid 7)"), (0, "")]
    monkeypatch.setattr("benchmarks.papers.work._for_so_long", lambda *_: answers.pop(0))
    monkeypatch.setattr("benchmarks.papers.work.LOOK", 0.0)
    assert TEAR.do(tmp_path / "tear", 100.0, 1)
    assert "waiting for it" in capsys.readouterr().out
    answers.append((1, "tear: another process works on this run (pid 7)"))
    assert not TEAR.go_on(tmp_path / "tear", 0.0, 1)


def test_a_run_that_was_killed_is_not_finished(tmp_path, monkeypatch, capsys):
    answers = [(1, "1 of 2 runs failed; was killed (SIGKILL); the same command goes on with it"), (1, "it blew up")]
    monkeypatch.setattr("benchmarks.papers.work._for_so_long", lambda *_: answers.pop(0))
    assert not TEAR.do(tmp_path / "tear", 100.0, 1)
    assert "was killed" in capsys.readouterr().out
    assert TEAR.do(tmp_path / "tear", 100.0, 1)


def test_work_of_which_nothing_can_be_shown_is_told_and_kept(tmp_path, monkeypatch, capsys):
    figure = FIGURES["cq2_fracture"]
    for work in figure.work(Size.QUICK):
        folder = tmp_path / "r" / "quick" / work.name
        folder.mkdir(parents=True)
        (folder / DONE).write_text(json.dumps({"fingerprint": work.fingerprint(), "seeds": 0, "engine": "-"}))
    monkeypatch.setattr(command, "publish", lambda *_: None)
    kept = []
    monkeypatch.setattr(command, "keep", lambda work, *_: kept.append(work.name))
    words = ["--only", "cq2_fracture", "--minutes", "0", "--runs", str(tmp_path / "r"), "--out", str(tmp_path / "o")]
    command.main(words)
    assert "nothing to show came of it" in capsys.readouterr().out
    assert len(kept) == len(figure.work(Size.QUICK))


def test_a_run_that_is_stopped_before_it_listens_goes_on_later():
    asleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    assert _for_so_long(asleep, time.monotonic(), lambda: None)[0] == STOPPED


def test_long_work_says_how_far_it_is(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr("benchmarks.papers.work.LOOK", 0.1)
    busy = [sys.executable, "-c", "import time; time.sleep(0.5)"]
    assert _for_so_long(busy, time.monotonic() + 60.0, lambda: said.append(1))[0] == 0
    assert said
    run = tmp_path / "tear" / "abc"
    run.mkdir(parents=True)
    (run / "run.json").write_text("{}")
    assert TEAR.progress(tmp_path) == "1 run begun"
    (run / "history.csv").write_text("iteration\n0\n1\n2\n")
    assert TEAR.progress(tmp_path) == "1 run begun, 2 iterations"


def test_killed_half_way_it_goes_on(tmp_path):
    """SIGKILL as the second of two works runs: the first is kept, and the same command finishes."""
    words = [sys.executable, "-m", "benchmarks.papers", "--only", "cq2_fracture", "--runs", str(tmp_path / "runs")]
    words += ["--out", str(tmp_path / "out")]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(words, cwd=ROOT, start_new_session=True, **pipes)
    first, deadline = tmp_path / "runs" / "quick" / "tear_1" / DONE, time.monotonic() + 120.0
    while not first.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    stamp = first.stat().st_mtime_ns
    assert not (tmp_path / "out" / "quick" / "cq2_fracture.png").exists()
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    assert first.stat().st_mtime_ns == stamp
    assert "reproduced" in done.stdout
    assert (tmp_path / "out" / "index.html").exists()


# --- what is published --------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("figure", [f for f in FIGURES.values() if isinstance(f, Distances)], ids=lambda f: f.id)
@pytest.mark.parametrize("size", Size)
def test_distances_are_drawn_and_judged(figure, size):
    """Two seeds of every variant that the size has, which walk as far as the paper's."""
    labels = [variant.label for variant in figure.variants if size in variant.seeds]
    far = 0.5 * figure.final
    rows = [
        {"variant": label, "seed": seed, "iteration": k, "seconds": 9.0 * k, "value": far * k + 0.01 * seed}
        for label in labels for seed in range(2) for k in range(3)
    ]  # fmt: skip
    table = stacked(iter(rows))
    assert figure.judge(table, size).judgement is Judgement.MET
    if size is Size.PAPER:
        flew = {**table, "value": 9.0 * table["value"]}
        assert figure.judge(flew, size).judgement is Judgement.EXCEEDED
    stood = {**table, "value": 0.0 * table["value"]}
    assert figure.judge(stood, size).judgement is Judgement.MISSED
    with styled():
        assert figure.draw(table, size, {}).axes


def test_what_ties_in_print_has_no_order():
    """The octopod's printed distances say that each of E, nu and mass adds as much, to what can be read off a plot."""
    octopod = FIGURES["cq2_fig14"]
    for last in (0.0, 1e-3, -1e-3):
        far = dict(zip(ORDER, octopod.printed, strict=True)) | {"E": octopod.printed[ORDER.index("E")] + last}
        rows = [
            {"variant": v, "seed": s, "iteration": 0, "value": far[v], "seconds": 0.0} for v in ORDER for s in (0, 1)
        ]
        assert octopod.judge(stacked(iter(rows)), Size.PAPER).judgement is Judgement.MET


@pytest.mark.parametrize("figure", [f for f in FIGURES.values() if isinstance(f, Ablation)], ids=lambda f: f.id)
@pytest.mark.parametrize("size", Size)
def test_ablations_are_drawn_and_judged(figure, size):
    """Two seeds of every combination, which walk as far as the paper's; then all as far as control alone."""
    rows = [
        {"variant": label, "seed": seed, "iteration": k, "seconds": 9.0 * k, "value": 0.5 * far * k + 1e-3 * seed}
        for label, far in zip(ORDER, figure.printed, strict=True) for seed in range(2) for k in range(3)
    ]  # fmt: skip
    table = stacked(iter(rows))
    assert figure.judge(table, size).judgement is Judgement.MET
    first = table["value"][table["variant"] == ORDER[0]]
    same = {**table, "value": np.tile(first, len(ORDER))}
    assert figure.judge(same, size).judgement is not Judgement.MET
    with styled():
        left, right = figure.draw(table, size, {}).axes
    far = {**table, "value": np.where(table["variant"] == ORDER[0], 1.0, 1.3) * table["value"]}
    short = {**table, "value": 0.1 * table["value"]}
    if size is Size.PAPER:
        assert figure.judge(far, size).judgement is Judgement.EXCEEDED
        # a gain counts only where control alone comes as far as the paper's
        assert figure.judge(short, size).judgement is Judgement.MISSED
    lacking = {name: column[(table["variant"] != ORDER[-1]) | (table["seed"] == 0)] for name, column in table.items()}
    assert figure.judge(lacking, size).judgement is Judgement.MET  # of a seed that blew up, none is compared
    none = {name: column[table["variant"] != ORDER[-1]] for name, column in table.items()}
    assert figure.judge(none, size).judgement is Judgement.MISSED
    assert "wall time of 'all' [s]" in left.get_xlabel()
    assert (right.get_legend() is not None) == (size is Size.PAPER)  # the printed values are of the paper's size


def test_a_body_that_is_torn_or_inside_out_or_was_not_watched_is_not_whole():
    crawler = FIGURES["cq1_crawler"]
    path = {"time": np.arange(2.0), **dict(zip("xyz", np.array([[0.7, 1.4], [0.2, 0.4], [0.5, 0.5]]), strict=True))}

    def judgement(**watched: float) -> Judgement:
        return crawler.judge(path | {name: np.full(2, value) for name, value in watched.items()}, Size.PAPER).judgement

    assert judgement(fracture=0.0, least_volume_ratio=0.1) is Judgement.MET
    assert judgement(fracture=0.01, least_volume_ratio=0.1) is Judgement.PARTLY
    assert judgement(fracture=0.0, least_volume_ratio=-0.04) is Judgement.PARTLY
    assert judgement() is Judgement.PARTLY


def test_a_table_comes_back(tmp_path):
    table = stacked(iter([{"name": "a, b", "x": 1.5}, {"name": "c", "y": 2.0}]))
    write_table(table, tmp_path / "t.csv")
    again = read_table(tmp_path / "t.csv")
    assert list(again["name"]) == ["a, b", "c"]
    np.testing.assert_array_equal(again["x"], [1.5, np.nan])
    np.testing.assert_array_equal(again["y"], [np.nan, 2.0])


def test_a_seed_that_has_ended_stays_where_it_ended():
    rows = [(0, 0, 1.0), (0, 1, 2.0), (1, 0, 3.0)]
    table = stacked(
        {"variant": "a", "seed": seed, "iteration": k, "seconds": float(k), "value": v} for seed, k, v in rows
    )
    found = curves(table, "a")
    np.testing.assert_array_equal(found.value, [[1.0, 2.0], [3.0, 3.0]])
    np.testing.assert_array_equal(found.mean, [2.0, 2.5])
    assert found.half[0] > 0


def test_means_over_a_window():
    np.testing.assert_allclose(smooth(np.array([1.0, 3.0, 5.0]), 2), [1.0, 2.0, 4.0])
    assert first_below(np.array([3.0, 1.0, 0.5]), 1.0) == 2
    assert first_below(np.array([3.0]), 1.0) is None


# --- command and page ---------------------------------------------------------------------------------------------


def test_the_list_names_every_figure(capsys):
    assert command.main(["--list"]) == 0
    told = capsys.readouterr().out
    assert all(figure.id in told and figure.title in told for figure in FIGURES.values())


def test_figures_may_be_named_in_one_option_or_in_several(capsys):
    assert command.main(["--list", "--only", "cq2_fig11", "cq2_fig12", "--only", "cq2_fig13"]) == 0
    told = capsys.readouterr().out
    assert {name for name in FIGURES if name in told} == {"cq2_fig11", "cq2_fig12", "cq2_fig13"}


def test_no_time_is_no_work(tmp_path, capsys):
    words = ["--only", "cq2_fracture", "--minutes", "0", "--runs", str(tmp_path / "r"), "--out", str(tmp_path / "o")]
    assert command.main(words) == 75
    assert "not all is done: the same command goes on" in capsys.readouterr().out


@pytest.fixture
def two_figures(tmp_path, monkeypatch):
    """The command's figures are two that count, to three each, and the words that run both."""
    toys = {}
    for name in ("one", "two"):
        toy = Toy(replace(COUNT, name=name, told=f"count {name}"))
        toy.id = name
        toys[name] = toy
    monkeypatch.setattr(command, "FIGURES", toys)
    monkeypatch.setattr(command, "write_page", lambda out: out)
    return toys, ["--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]


def test_a_figure_that_cannot_be_does_not_end_the_others(two_figures, capsys):
    toys, words = two_figures

    def broken(folder, deadline):
        raise WorkError("it does not count")

    toys["one"].works = (replace(toys["one"].works[0], measure=broken),)
    assert [command.main(words) for _ in range(3)] == [1, 1, 1]
    told = capsys.readouterr().out
    assert "error: it does not count" in told
    assert "quick: reproduced: they grow (yes)" in told


def test_a_part_is_not_written_over_the_whole(two_figures, tmp_path, capsys):
    """A fresh clone has the figures that are committed, and none of their runs."""
    _, words = two_figures
    assert [command.main(words) for _ in range(3)] == [75, 75, 0]
    files = sorted((tmp_path / "out" / "quick").glob("*.*"))
    before = [file.read_bytes() for file in files]
    shutil.rmtree(tmp_path / "runs")
    assert command.main(words) == 75
    assert "what is published is complete, and stays" in capsys.readouterr().out
    assert [file.read_bytes() for file in files] == before


def test_work_that_figures_share_is_counted_once(two_figures, capsys):
    toys, words = two_figures
    toys["two"].works = toys["one"].works
    command.main([*words, "--minutes", "0"])
    told = capsys.readouterr().out
    assert "2 figures, size quick: about 1 min of work left" in told


def test_committed_curves_of_ppo_are_of_the_work_that_they_are_taken_for(tmp_path, monkeypatch):
    finger = FIGURES["cq1_fig7_fixed"]
    monkeypatch.setattr("benchmarks.papers.learners.importlib.util.find_spec", lambda name: None)
    *_, ppo = finger.work(Size.QUICK)
    assert ppo.do(tmp_path / "a", 1.0, 1)
    monkeypatch.setattr(type(finger), "squared", "")
    *_, other = finger.work(Size.QUICK)
    assert not other.do(tmp_path / "b", 1.0, 1)


def test_the_gallery_is_of_what_is_committed(tmp_path):
    """`python -m benchmarks.papers --page` was run after what is committed was published."""
    shutil.copytree(PUBLISHED, tmp_path / "figures")
    write_page(tmp_path / "figures")
    assert (tmp_path / "figures" / "README.md").read_text() == (PUBLISHED / "README.md").read_text()


def test_the_page_stands_alone(tmp_path):
    page = write_page(tmp_path).read_text()
    assert all(f'id="{figure.id}"' in page for figure in FIGURES.values())
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page)
    assert "Not run yet: <code>python -m benchmarks.papers --only cq1_table2</code>" in page


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.skipif(shutil.which("chromium") is None, reason="Debian's package chromium is absent")
def test_the_page_in_a_browser(tmp_path, width):
    """Every picture is loaded, and nothing is wider than the window or than where it stands."""
    page = write_page(PUBLISHED if list(PUBLISHED.glob("quick/*.json")) else tmp_path).read_text()
    script = """<script>addEventListener("load", () => {
      const shown = i => i.naturalWidth > 0 && i.getBoundingClientRect().width > 0;
      parent.document.title = JSON.stringify({width: innerWidth,
        broken: [...document.images].filter(i => !shown(i)).length,
        wide: document.documentElement.scrollWidth - innerWidth,
        cut: [...document.querySelectorAll(".scroll")].map(box => box.scrollWidth - box.clientWidth),
        sections: document.querySelectorAll("section").length}) })</script>"""
    (tmp_path / "page.html").write_text(page.replace(' loading="lazy"', "").replace("</body>", script + "</body>"))
    probe = tmp_path / "probe.html"  # a window of Chromium's own is no narrower than 500
    probe.write_text(f'<title></title><iframe src="page.html" style="border: 0; width: {width}px; height: 900px">')
    words = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    words += ["--allow-file-access-from-files", "--dump-dom", "--virtual-time-budget=20000"]
    words += [f"--user-data-dir={tmp_path / 'profile'}", probe.as_uri()]
    seen = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True).stdout
    (title,) = re.findall(r"<title>(\{.*?\})</title>", seen)
    told = json.loads(title)
    assert told["width"] == width
    assert told["broken"] == 0
    assert told["wide"] <= 0
    assert max(told["cut"]) <= 0
    assert told["sections"] == len(FIGURES)

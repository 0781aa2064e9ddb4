"""Work behind figures: it goes on where it stopped, and what has changed is done anew."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from toys import COUNT, TEAR

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.families import train_ppo
from benchmarks.papers.figure import Size
from benchmarks.papers.machinery import rebuild
from benchmarks.papers.machinery.process import HELD, ROOT, STOPPED, for_so_long
from benchmarks.papers.machinery.work import CLOCK, DONE, WorkError
from cqrun.errors import UsageError
from cqrun.store.atomic import write_json
from cqrun.store.lock import DirectoryLock


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

    monkeypatch.setattr("benchmarks.papers.machinery.work.TICK", 0.02)
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
    monkeypatch.setattr("benchmarks.papers.machinery.work.SCENES", tmp_path)
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
    monkeypatch.setattr("benchmarks.papers.machinery.work.SCENES", tmp_path)
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
    monkeypatch.setattr("benchmarks.papers.machinery.work.SCENES", tmp_path)
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


def test_seeds_and_variants_run_side_by_side(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "benchmarks.papers.machinery.process.for_so_long", lambda words, *_: asked.append(words) or (0, "")
    )
    monkeypatch.setattr("benchmarks.papers.machinery.work.cores", lambda threads: 4)
    for seeds, options, share in ((0, (), 1.0), (1, (), 0.5), (3, (), 1.0), (1, ("--ablate",), 1.0)):
        replace(TEAR, seeds=seeds, options=options).go_on(tmp_path, 1.0, 2, share)
    for option, given in (("--jobs", ["", "1", "2", "2"]), ("--threads", ["", "2", "", ""])):
        assert [words[words.index(option) + 1] if option in words else "" for words in asked] == given


def test_a_run_that_cannot_be_ends_with_its_command(tmp_path):
    broken = replace(TEAR, overrides=("time.duration=-1",))
    with pytest.raises(WorkError, match=r"tear: `cqrun simulate .*` ended with 2\n(.|\n)*time.duration"):
        broken.do(tmp_path / "tear", 100.0, 1)


def test_a_run_that_another_process_holds_is_waited_for(tmp_path, monkeypatch, capsys):
    """Whoever began it was killed, and it goes on alone."""
    answers = [(1, "tear: another process works on this run (pid 7)"), (0, "")]
    monkeypatch.setattr("benchmarks.papers.machinery.process.for_so_long", lambda *_: answers.pop(0))
    monkeypatch.setattr("benchmarks.papers.machinery.process.LOOK", 0.0)
    assert TEAR.do(tmp_path / "tear", 100.0, 1)
    assert "waiting for it" in capsys.readouterr().out
    answers.append((1, "tear: another process works on this run (pid 7)"))
    assert not TEAR.go_on(tmp_path / "tear", 0.0, 1, 1.0)


def test_a_run_that_was_killed_is_not_finished(tmp_path, monkeypatch, capsys):
    answers = [(1, "1 of 2 runs failed; was killed (SIGKILL); the same command goes on with it"), (1, "it blew up")]
    monkeypatch.setattr("benchmarks.papers.machinery.process.for_so_long", lambda *_: answers.pop(0))
    assert not TEAR.do(tmp_path / "tear", 100.0, 1)
    assert "was killed" in capsys.readouterr().out
    ended(tmp_path / "tear", "failed")
    assert TEAR.do(tmp_path / "tear", 100.0, 1)


def test_a_seed_that_never_began_is_missed(tmp_path, monkeypatch):
    """Its process ended before it had a record; the others are no result without it."""
    monkeypatch.setattr("benchmarks.papers.machinery.process.for_so_long", lambda *_: (1, "the disk is full"))
    two = replace(TEAR, seeds=2)
    ended(tmp_path / "tear", "iteration_limit")
    with pytest.raises(WorkError, match="the disk is full"):
        two.go_on(tmp_path / "tear", 100.0, 1, 1.0)
    ended(tmp_path / "tear", "iteration_limit", "ba9876543210")
    assert two.go_on(tmp_path / "tear", 100.0, 1, 1.0)


def ended(folder, status, name="0123456789ab"):
    """Leave a run that ended so."""
    run = folder / "tear" / name / "run.json"
    run.parent.mkdir(parents=True, exist_ok=True)
    run.write_text(json.dumps({"job": "simulate", "status": status, "reason": "", "seconds": 0.0, "files": {}}))


@pytest.mark.parametrize("status", ["", "new", "running", "stopped"])
def test_a_run_that_ends_before_it_is_done_is_no_result(tmp_path, monkeypatch, status):
    """As where the disk is full: cqrun ends with 1 there, too."""
    monkeypatch.setattr("benchmarks.papers.machinery.process.for_so_long", lambda *_: (1, "no space left"))
    if status:
        ended(tmp_path / "tear", status)
    with pytest.raises(WorkError, match=r"ended with 1 before it was done\nno space left"):
        TEAR.go_on(tmp_path / "tear", 100.0, 1, 1.0)


def test_more_parts_go_on(tmp_path):
    """As with seeds: what PPO has learned from one is not what three have."""
    folder = tmp_path / "count"
    while not COUNT.do(folder, 1.0, 1):
        pass
    assert COUNT.done(folder) is not None
    more = replace(COUNT, parts=2)
    assert more.done(folder) is None
    (folder / "2.txt").unlink()  # what the next part writes
    assert more.do(folder, 1.0, 1)
    assert more.done(folder)["parts"] == 2
    write_json(folder / DONE, {"fingerprint": more.fingerprint()})  # written before there were parts
    assert more.done(folder) is not None


def test_rows_of_two_engines_are_not_mixed(tmp_path, monkeypatch):
    assert not COUNT.do(tmp_path / "count", 9.0, 1)
    for module in ("work", "measurement"):
        monkeypatch.setattr(f"benchmarks.papers.machinery.{module}.engine_hash", lambda: "another")
    assert not COUNT.do(tmp_path / "count", 9.0, 1)
    assert [file.name for file in (tmp_path / "count").glob("*.txt")] == ["0.txt"]
    assert COUNT.engine(tmp_path / "count") == "another"


def test_work_of_which_nothing_can_be_shown_is_told_and_kept(tmp_path, monkeypatch, capsys):
    figure = FIGURES["cq2_fracture"]
    for work in figure.work(Size.QUICK):
        folder = tmp_path / "r" / "quick" / work.name
        folder.mkdir(parents=True)
        (folder / DONE).write_text(json.dumps({"fingerprint": work.fingerprint(), "seeds": 0, "engine": "-"}))
    monkeypatch.setattr(rebuild, "publish", lambda *_: None)
    kept = []
    monkeypatch.setattr(rebuild, "keep", lambda work, *_: kept.append(work.name))
    rebuild.show(figure, Size.QUICK, tmp_path / "r" / "quick", tmp_path / "o")
    assert "nothing to show came of it" in capsys.readouterr().out
    assert len(kept) == len(figure.work(Size.QUICK))


def test_a_run_that_is_stopped_before_it_listens_goes_on_later():
    asleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    assert for_so_long(asleep, time.monotonic(), lambda: None)[0] == STOPPED


def test_long_work_says_how_far_it_is(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr("benchmarks.papers.machinery.process.LOOK", 0.1)
    monkeypatch.setattr("benchmarks.papers.machinery.process.BEAT", 0.1)
    busy = [sys.executable, "-c", "import time; time.sleep(0.5)"]
    assert for_so_long(busy, time.monotonic() + 60.0, lambda: said.append(1))[0] == 0
    assert said
    run = tmp_path / "tear" / "abc"
    run.mkdir(parents=True)
    (run / "run.json").write_text("{}")
    assert TEAR.progress(tmp_path) == "1 run begun"
    (run / "history.csv").write_text("iteration\n0\n1\n2\n")
    assert TEAR.progress(tmp_path) == "1 run begun, 2 iterations"


def test_several_runs_tell_the_time_left_by_their_own_pace(tmp_path):
    """Ten runs of 30 minutes as declared: two that ended in 40 leave eight of 20 each."""
    work = replace(TEAR, seeds=5, variants=2, minutes=300.0)
    write_json(tmp_path / CLOCK, {"fingerprint": work.fingerprint(), "engine": "e", "seconds": 2400.0})
    for k, status in enumerate(("iteration_limit", "running", "failed")):
        assert work.left(tmp_path) == pytest.approx(260.0)
        ended(tmp_path, status, str(k))
    assert work.left(tmp_path) == pytest.approx(160.0)
    assert replace(work, seeds=1).left(tmp_path) == 0.0
    (tmp_path / "tear" / "0" / "run.json").write_text('{"sta')
    assert work.left(tmp_path) == pytest.approx(260.0)


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


def test_who_was_killed_may_train_on_alone_and_is_waited_for(tmp_path, monkeypatch):
    """Its orphan holds the folder; what it has found by its end is not trained once more."""
    learned = tmp_path / "finger-0.csv"
    words = ["finger.yaml", "3", "0", str(learned), "measure of it"]
    monkeypatch.setattr(train_ppo, "train_ppo", lambda *_: [0.5, 0.25])
    lock = DirectoryLock(tmp_path)
    with pytest.raises(UsageError, match=HELD):
        train_ppo.main(words)
    lock.release()
    train_ppo.main(words)
    assert learned.read_text() == "measure of it\n0.5\n0.25\n"
    monkeypatch.setattr(train_ppo, "train_ppo", lambda *_: 1 / 0)
    train_ppo.main(words)

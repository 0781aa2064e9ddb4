"""Work side by side: what there is room for, what wants to be alone, and what happens when all is stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from toys import COUNT, TEAR

from benchmarks.papers.machinery import process
from benchmarks.papers.machinery.process import OVER, ROOT, STOPPED, for_so_long, with_memory
from benchmarks.papers.machinery.scheduler import in_turn

ALONE, FIRST, SECOND, THIRD = (
    replace(COUNT, name=name, alone=name == "alone") for name in ("alone", "first", "second", "third")
)


class Watch:
    """Work that ends when enough is at work, or not at all: it tells what ran beside what."""

    def __init__(self, together):
        self.together = threading.Barrier(together, timeout=20.0)
        self.now, self.seen, self.shares = set(), [], {}

    def __call__(self, work, share):
        self.now.add(work.name)
        self.shares[work.name] = share
        if not work.is_alone:
            self.together.wait()
        self.seen.append(set(self.now))
        if not work.is_alone:
            self.together.wait()
        self.now.discard(work.name)
        return True


def test_single_work_runs_side_by_side_and_what_wants_the_machine_waits_for_it():
    watch = Watch(2)
    ended = [work.name for work, _ in in_turn([FIRST, ALONE, SECOND], 2, watch)]
    assert sorted(ended[:2]) == ["first", "second"]
    assert ended[2] == "alone"
    assert watch.seen == [{"first", "second"}] * 2 + [{"alone"}]
    assert watch.shares == {"first": 0.5, "second": 0.5, "alone": 1.0}


def test_work_that_is_all_there_is_has_the_whole_machine():
    watch = Watch(1)
    assert list(in_turn([FIRST], 2, watch)) == [(FIRST, True)]
    assert watch.shares == {"first": 1.0}


def test_what_goes_wrong_in_work_is_told_and_ends_no_other():
    fault = ValueError("it does not count")

    def do(work, share):
        if work is FIRST:
            raise fault
        return work is SECOND

    assert dict(in_turn([FIRST, SECOND, THIRD], 2, do)) == {FIRST: fault, SECOND: True, THIRD: False}


def test_one_at_a_time_is_in_order():
    assert [work for work, _ in in_turn([FIRST, ALONE, SECOND], 1, lambda *_: True)] == [FIRST, ALONE, SECOND]
    assert list(in_turn([], 2, lambda *_: True)) == []


def test_who_is_interrupted_leaves_no_run_behind(monkeypatch):
    """The runs are asked to stop, and waited for; a measurement, which listens to no one, is not."""
    monkeypatch.setattr(process, "BEAT", 0.02)
    asleep, codes, forever = [sys.executable, "-c", "import time; time.sleep(60)"], [], threading.Event()

    def do(work, share):
        if work is SECOND:
            return True
        if work is FIRST:
            return forever.wait(60.0)
        codes.append(for_so_long(asleep, time.monotonic() + 60.0, lambda: None)[0])
        return False

    turns = in_turn([TEAR, SECOND, FIRST], 3, do)
    assert next(turns) == (SECOND, True)
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        turns.throw(KeyboardInterrupt())
    assert codes == [STOPPED]
    assert time.monotonic() - begun < 30.0
    forever.set()
    OVER.clear()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells how much memory another had")
def test_the_memory_of_a_command_is_its_own_and_it_is_stopped_with_everything(monkeypatch):
    monkeypatch.setattr(process, "BEAT", 0.02)
    ours = bytearray(b"1") * 600_000_000  # which a child does not count
    busy = "import sys, time; print(1); b = b'1' * 300_000_000; time.sleep(0.5); sys.exit(3)"
    code, said, memory = with_memory("busy", [sys.executable, "-c", busy], time.monotonic() + 60.0)
    assert (code, said, len(ours)) == (3, "1\n", 600_000_000)
    assert 0.3 < memory < 0.4
    asleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    assert with_memory("asleep", asleep, time.monotonic())[0] == STOPPED
    OVER.set()
    assert with_memory("asleep", asleep, time.monotonic() + 60.0)[0] == STOPPED
    OVER.clear()


def test_what_is_timed_waits_for_a_run_whose_parent_was_killed(monkeypatch):
    """The child of a command that was killed by SIGKILL alone goes on, and holds its run."""
    answers = [(2, "error: another process works on this run (pid 7)"), (0, "")]
    monkeypatch.setattr(process, "for_so_long", lambda *_: answers.pop(0))
    monkeypatch.setattr(process, "LOOK", 0.0)
    assert with_memory("biped", [], time.monotonic() + 60.0)[0] == 0
    assert not answers


def test_asked_to_stop_the_command_asks_its_runs_and_goes_on_later(tmp_path):
    words = [sys.executable, "-m", "benchmarks.papers", "--only", "cq2_fracture", "--runs", str(tmp_path / "runs")]
    words += ["--out", str(tmp_path / "out")]
    child = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 120.0
    while not list((tmp_path / "runs").rglob("run.json")) and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGTERM)
    said, _ = child.communicate(timeout=300.0)
    assert said.endswith("stopped: the same command goes on\n")
    assert child.returncode == STOPPED
    records = [json.loads(file.read_text()) for file in (tmp_path / "runs").rglob("run.json")]
    assert records
    assert "running" not in {record["status"] for record in records}

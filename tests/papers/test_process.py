"""Commands that run for a limited time: they are asked to stop, report, and wait for a run that is in use."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from benchmarks.papers.families import train_ppo
from benchmarks.papers.machinery import process
from benchmarks.papers.machinery.process import IN_USE, STOP, STOPPED, Ended, run_command
from cqrun.errors import UsageError
from cqrun.store.lock import DirectoryLock

ASLEEP = [sys.executable, "-c", "import time; time.sleep(60)"]


def test_a_command_that_is_stopped_before_it_listens_continues_later():
    assert run_command("asleep", ASLEEP, time.monotonic()).status == STOPPED


def test_a_long_command_reports_its_progress(monkeypatch):
    reports = []
    monkeypatch.setattr(process, "REPORT_EVERY", 0.1)
    monkeypatch.setattr(process, "POLL_EVERY", 0.1)
    busy = [sys.executable, "-c", "import time; time.sleep(0.5)"]
    assert run_command("busy", busy, time.monotonic() + 60.0, lambda: reports.append(1)).status == 0
    assert reports


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells how much memory another had")
def test_the_memory_of_a_command_is_its_own_and_it_is_stopped_with_everything(monkeypatch):
    monkeypatch.setattr(process, "POLL_EVERY", 0.02)
    ours = bytearray(b"1") * 600_000_000  # which a child does not count
    busy = "import sys, time; print(1); b = b'1' * 300_000_000; time.sleep(0.5); sys.exit(3)"
    status, output, memory = run_command("busy", [sys.executable, "-c", busy], time.monotonic() + 60.0)
    assert (status, output, len(ours)) == (3, "1\n", 600_000_000)
    assert 0.3 < memory < 0.4
    assert run_command("asleep", ASLEEP, time.monotonic()).status == STOPPED
    STOP.set()
    assert run_command("asleep", ASLEEP, time.monotonic() + 60.0).status == STOPPED
    STOP.clear()


def test_a_command_waits_for_a_run_whose_parent_was_killed(monkeypatch):
    """The child of a command that was killed by SIGKILL continues alone, and has its run."""
    answers = [Ended(2, "error: another process works on this run (pid 7)", 0.0), Ended(0, "", 0.0)]
    monkeypatch.setattr(process, "_run_once", lambda *_: answers.pop(0))
    monkeypatch.setattr(process, "REPORT_EVERY", 0.0)
    assert run_command("biped", [], time.monotonic() + 60.0).status == 0
    assert not answers


def test_a_training_whose_parent_was_killed_is_waited_for(tmp_path, monkeypatch):
    """It has the folder; what it has found by its end is not trained again."""
    learned = tmp_path / "finger-0.csv"
    words = ["finger.yaml", "3", "0", str(learned), "measure of it"]
    monkeypatch.setattr(train_ppo, "train_ppo", lambda *_: [0.5, 0.25])
    lock = DirectoryLock(tmp_path)
    with pytest.raises(UsageError, match=IN_USE):
        train_ppo.main(words)
    lock.release()
    train_ppo.main(words)
    assert learned.read_text() == "measure of it\n0.5\n0.25\n"
    monkeypatch.setattr(train_ppo, "train_ppo", lambda *_: 1 / 0)
    train_ppo.main(words)

"""Several runs at once, tested with small programs in place of cqrun."""

from __future__ import annotations

import signal
import sys
import threading
import time

import pytest
from small_beam import Listener

from cqrun.running import fleet
from cqrun.running.fleet import Member, run_fleet
from cqrun.store.lock import DirectoryLock

FAILS_AT_ONE = """
import sys, time
time.sleep(0.5)
sys.exit(f'an earlier line\\nerror: {sys.argv[1]}/1: seed one blew up' if sys.argv[-1] == 'seed=1' else 0)
"""
WAITS = """
import pathlib, signal, sys, time
def stop(number, frame): sys.exit(130 if number == signal.SIGINT else 75)
signal.signal(signal.SIGINT, stop)
signal.signal(signal.SIGTERM, stop)
pathlib.Path(sys.argv[1], sys.argv[-1]).touch()
time.sleep(60)
"""
KILLED = "was killed (SIGKILL); the same command goes on with it"


@pytest.fixture
def three_runs(tmp_path):
    """Return a function that makes three runs of a program; they have not started."""

    def make(*program: str) -> list[Member]:
        command = [sys.executable, "-c", *program]
        return [Member(f"seed {k}", tmp_path / str(k), [*command, f"seed={k}"], 5) for k in range(3)]

    return make


def test_a_failed_seed_is_reported_with_its_run_and_the_others_continue(three_runs, tmp_path):
    listener = Listener()
    runs = three_runs(FAILS_AT_ONE, str(tmp_path))
    run_fleet(runs, 2, "seeds", listener)
    assert [run.failure for run in runs] == [None, "seed one blew up", None]
    assert listener.said == [f"warning: seed 1 ({runs[1].run}): seed one blew up"]
    assert listener.parts[-1] == (15, 15, "3 of 3 seeds")
    assert any(", seed 0 at 0/5, seed 1 at 0/5" in text for _, _, text in listener.parts)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_a_stop_request_reaches_all_processes_and_none_starts_after_it(three_runs, tmp_path, number, code):
    listener = Listener()

    def when_two_run() -> None:
        while len(list(tmp_path.glob("seed=*"))) < 2:
            time.sleep(0.01)
        listener.stop.ask(number)

    watcher = threading.Thread(target=when_two_run)
    watcher.start()
    runs = three_runs(WAITS, str(tmp_path))
    run_fleet(runs, 2, "seeds", listener)
    watcher.join()
    assert [run.failure for run in runs] == [
        f"ended with exit code {code}",
        f"ended with exit code {code}",
        "not started",
    ]
    assert [run.process for run in runs] == [None] * 3
    assert listener.said == []


def test_an_error_while_waiting_kills_all_processes(three_runs, tmp_path, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(fleet, "report_progress", interrupted)
    runs = three_runs(WAITS, str(tmp_path))
    with pytest.raises(KeyboardInterrupt):
        run_fleet(runs, 2, "seeds", Listener())
    assert [run.failure for run in runs] == [KILLED, KILLED, None]


def test_the_failure_of_a_killed_run_is_not_its_last_message(three_runs):
    runs = three_runs("import os, sys; print('warning: old', file=sys.stderr, flush=True); os.kill(os.getpid(), 9)")
    run_fleet(runs[:1], 1, "seeds", Listener())
    assert runs[0].failure == KILLED


def test_it_waits_for_a_run_that_another_process_works_on(three_runs, tmp_path):
    listener, runs = Listener(), three_runs("import sys; sys.exit(0)")
    runs[1].run.mkdir()
    lock = DirectoryLock(runs[1].run)

    def when_it_is_announced() -> None:
        while not any("another process" in line for line in listener.said):
            time.sleep(0.01)
        assert runs[1].process is None
        lock.release()

    watcher = threading.Thread(target=when_it_is_announced)
    watcher.start()
    run_fleet(runs, 2, "seeds", listener)
    watcher.join()
    assert [run.failure for run in runs] == [None] * 3
    assert listener.said == [f"warning: seed 1 ({runs[1].run}): another process works on it; waiting until it ends"]


def test_a_wait_for_another_process_can_be_stopped(three_runs):
    listener, runs = Listener(), three_runs("import sys; sys.exit(0)")
    runs[1].run.mkdir()
    lock = DirectoryLock(runs[1].run)

    def when_only_the_locked_run_is_left() -> None:
        while not any("another process" in line for line in listener.said):
            time.sleep(0.01)
        listener.stop.ask(signal.SIGINT)

    watcher = threading.Thread(target=when_only_the_locked_run_is_left)
    watcher.start()
    run_fleet(runs, 1, "seeds", listener)
    watcher.join()
    lock.release()
    assert [run.failure for run in runs] == [None, "not started", None]

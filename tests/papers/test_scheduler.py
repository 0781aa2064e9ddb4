"""Tasks side by side: what there is room for, what runs alone, and what happens when everything is stopped."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import replace

import pytest
from toys import COUNT, TEAR

from benchmarks.papers.machinery import process
from benchmarks.papers.machinery.process import STOP, STOPPED, run_command
from benchmarks.papers.machinery.scheduler import schedule

ALONE, FIRST, SECOND, THIRD = (
    replace(COUNT, name=name, exclusive=name == "alone") for name in ("alone", "first", "second", "third")
)


class Watch:
    """Tasks that end when enough of them run, or never: it records what runs beside what."""

    def __init__(self, together):
        self.together = threading.Barrier(together, timeout=20.0)
        self.now, self.seen, self.shares = set(), [], {}

    def __call__(self, task, share):
        self.now.add(task.name)
        self.shares[task.name] = share
        if not task.exclusive:
            self.together.wait()
        self.seen.append(set(self.now))
        if not task.exclusive:
            self.together.wait()
        self.now.discard(task.name)
        return True


def test_single_tasks_run_side_by_side_and_an_exclusive_one_waits_for_them():
    watch = Watch(2)
    ended = [task.name for task, _ in schedule([FIRST, ALONE, SECOND], 2, watch)]
    assert sorted(ended[:2]) == ["first", "second"]
    assert ended[2] == "alone"
    assert watch.seen == [{"first", "second"}] * 2 + [{"alone"}]
    assert watch.shares == {"first": 0.5, "second": 0.5, "alone": 1.0}


def test_the_only_task_has_the_whole_machine():
    watch = Watch(1)
    assert list(schedule([FIRST], 2, watch)) == [(FIRST, True)]
    assert watch.shares == {"first": 1.0}


def test_an_error_in_a_task_is_yielded_and_stops_no_other():
    fault = ValueError("it does not count")

    def do(task, share):
        if task is FIRST:
            raise fault
        return task is SECOND

    assert dict(schedule([FIRST, SECOND, THIRD], 2, do)) == {FIRST: fault, SECOND: True, THIRD: False}


def test_one_at_a_time_is_in_order():
    assert [task for task, _ in schedule([FIRST, ALONE, SECOND], 1, lambda *_: True)] == [FIRST, ALONE, SECOND]
    assert list(schedule([], 2, lambda *_: True)) == []


def test_an_interrupt_leaves_no_run_behind(monkeypatch):
    """Runs are asked to stop, and waited for. A measurement does not look at STOP, and is not waited for."""
    monkeypatch.setattr(process, "POLL_EVERY", 0.02)
    asleep, statuses, forever = [sys.executable, "-c", "import time; time.sleep(60)"], [], threading.Event()

    def do(task, share):
        if task is SECOND:
            return True
        if task is FIRST:
            return forever.wait(60.0)
        statuses.append(run_command("asleep", asleep, time.monotonic() + 60.0).status)
        return False

    tasks = schedule([TEAR, SECOND, FIRST], 3, do)
    assert next(tasks) == (SECOND, True)
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        tasks.throw(KeyboardInterrupt())
    assert statuses == [STOPPED]
    assert time.monotonic() - start < 30.0
    forever.set()
    STOP.clear()

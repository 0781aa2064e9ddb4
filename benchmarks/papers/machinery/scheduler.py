"""Which task runs when: single runs side by side, each with a share of the machine; exclusive tasks alone."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from queue import SimpleQueue

from benchmarks.papers.machinery.process import GRACE, POLL_EVERY, STOP
from benchmarks.papers.machinery.runs import Runs
from benchmarks.papers.machinery.task import Task

Outcome = bool | Exception
"""Whether a task is finished, or why it failed."""


def schedule(tasks: Sequence[Task], at_once: int, do: Callable[[Task, float], bool]) -> Iterator[tuple[Task, Outcome]]:
    """Do tasks, the first first that there is room for, and yield each as it ends.

    No run is left behind if the caller is interrupted, by a signal or by an error in its loop.

    Args:
        tasks: each once.
        at_once: how many may run side by side.
        do: (task, its share of the machine) -> whether it is finished.
    """
    at_once = min(at_once, len(tasks))
    waiting, ended = list(tasks), SimpleQueue[tuple[Task, Outcome]]()
    running: dict[Task, threading.Thread] = {}

    def run(task: Task) -> None:
        try:
            ended.put((task, do(task, 1.0 if task.exclusive else 1.0 / at_once)))
        except Exception as error:
            ended.put((task, error))

    STOP.clear()
    try:
        while waiting or running:
            while (task := _next(waiting, running, at_once)) is not None:
                waiting.remove(task)
                running[task] = threading.Thread(target=run, args=(task,), daemon=True, name=task.name)
                running[task].start()
            task, outcome = ended.get()
            del running[task]
            yield task, outcome
    except BaseException:
        STOP.set()
        for task, thread in running.items():  # most measurements do not look at STOP
            thread.join(GRACE if isinstance(task, Runs) else 4.0 * POLL_EVERY)
        raise


def _next(waiting: Sequence[Task], running: Collection[Task], at_once: int) -> Task | None:
    """Return the first task that there is room for. An exclusive one waits until no other runs."""
    if len(running) >= at_once or any(task.exclusive for task in running):
        return None
    return next((task for task in waiting if not (task.exclusive and running)), None)

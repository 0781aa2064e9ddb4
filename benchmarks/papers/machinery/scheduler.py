"""Whose turn it is: single runs side by side, a share of the machine each; what wants the whole of it, alone."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from queue import SimpleQueue

from benchmarks.papers.machinery.process import BEAT, GRACE, OVER
from benchmarks.papers.machinery.work import Runs, Work

Outcome = bool | Exception
"""Whether work is finished, or why it cannot be."""


def in_turn(works: Sequence[Work], at_once: int, do: Callable[[Work, float], bool]) -> Iterator[tuple[Work, Outcome]]:
    """Do work, the first first that there is room for, and yield each as it ends.

    A caller that is interrupted, by a signal or in the midst of its loop, leaves no run behind.

    Args:
        works: each once.
        at_once: how many may run side by side.
        do: (work, its share of the machine) -> whether it is finished.
    """
    at_once = min(at_once, len(works))
    waiting, ended = list(works), SimpleQueue[tuple[Work, Outcome]]()
    running: dict[Work, threading.Thread] = {}

    def run(work: Work) -> None:
        try:
            ended.put((work, do(work, 1.0 if work.is_alone else 1.0 / at_once)))
        except Exception as error:
            ended.put((work, error))

    OVER.clear()
    try:
        while waiting or running:
            while (work := _next(waiting, running, at_once)) is not None:
                waiting.remove(work)
                running[work] = threading.Thread(target=run, args=(work,), daemon=True, name=work.name)
                running[work].start()
            work, outcome = ended.get()
            del running[work]
            yield work, outcome
    except BaseException:
        OVER.set()
        for work, thread in running.items():
            thread.join(GRACE if isinstance(work, Runs) else 4.0 * BEAT)  # most measurements listen to no one
        raise


def _next(waiting: Sequence[Work], running: Collection[Work], at_once: int) -> Work | None:
    """Return the first work that there is room for: what wants to be alone waits for the others to end."""
    if len(running) >= at_once or any(work.is_alone for work in running):
        return None
    return next((work for work in waiting if not (work.is_alone and running)), None)

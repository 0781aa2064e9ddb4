"""A team of threads that run the same compiled loop, each with its number."""

from __future__ import annotations

import os
import threading
import time
import weakref
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np

from cqrun.errors import StopNow
from cqrun.numerics.packed import LINE, aligned

Tasks = SimpleQueue[Any]
"""Tasks of one thread: (body, number of the thread, queue for the answer), or None to end it."""

Answers = SimpleQueue[BaseException | None]
"""The error of each thread but the first, or None."""


class Team:
    """Run functions on `size` threads, the caller's included, which are started once because starting is slow.

    `arrivals` is the memory of their barrier (`compile.barrier`), on a cache line of its own.
    """

    def __init__(self, size: int) -> None:
        self.size, self.arrivals = size, aligned((LINE // 8,), np.int64)
        self._process, self._others = 0, list[Tasks]()

    def __reduce__(self) -> tuple[type[Team], tuple[int]]:
        """Copy the size only: a copy starts its own threads."""
        return Team, (self.size,)

    def run(self, body: Callable[[int], Any]) -> Any:
        """Run body(thread) on every thread and return the result of thread 0.

        Raises:
            RuntimeError: an earlier run was interrupted. Errors of a body are raised again.
        """
        if self.size == 1:
            return body(0)
        if self.arrivals[1]:
            raise RuntimeError("threads were interrupted in the middle of a rollout: make a new one")
        if self._process != os.getpid():  # the first run, or a forked child: it has no threads yet
            self._start()
        answers, asked = Answers(), 0
        try:
            for thread, tasks in enumerate(self._others, start=1):
                tasks.put((body, thread, answers))
                asked += 1
            result = body(0)
        except BaseException:
            self.arrivals[1] = 1  # otherwise the others would wait for this thread at a barrier for ever
            _wait(answers, asked)
            raise
        for error in [answers.get() for _ in self._others]:
            if error is not None:
                raise error
        return result

    def _start(self) -> None:
        self._process, self._others = os.getpid(), [Tasks() for _ in range(self.size - 1)]
        for tasks in self._others:
            threading.Thread(target=_work, args=(tasks,), daemon=True).start()
        weakref.finalize(self, _dismiss, self._others)


def _work(tasks: Tasks) -> None:
    """Do one task after another."""
    while (task := tasks.get()) is not None:
        body, thread, answers = task
        try:
            body(thread)
            answers.put(None)
        except BaseException as error:
            answers.put(error)
        del task, body, answers  # an idle thread must not keep a rollout alive


def _wait(answers: Answers, asked: int) -> None:
    """Wait for the threads that still write to the rollout's memory, even after another interrupt."""
    while True:
        try:
            while answers.qsize() < asked:  # `get` could lose an answer if it is interrupted
                time.sleep(1e-3)
            return
        except (KeyboardInterrupt, StopNow):
            continue


def _dismiss(others: list[Tasks]) -> None:
    for tasks in others:
        tasks.put(None)

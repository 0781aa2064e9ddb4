"""Do the tasks behind figures, and publish each figure when its tasks have ended."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.papers.figure import Figure, Size
from benchmarks.papers.machinery.archive import archive_path, pack, unpack
from benchmarks.papers.machinery.process import FAILED, STOPPED
from benchmarks.papers.machinery.publish import Publication, Record, attempt, begun_folders
from benchmarks.papers.machinery.scheduler import schedule
from benchmarks.papers.machinery.task import Task, duration
from cqrun.errors import CqrunError
from cqrun.running.cluster import PROCESSES


class Rebuild:
    """Everything that is missing of some figures.

    Args:
        figures: in the order in which they are begun.
        size: of their tasks.
        runs: holds the folders of all tasks of this size.
        out: results/figures.
        minutes: how long it may take; the rest continues later.
        jobs: runs side by side.
        on: where tasks with several runs make them: here, or a place as of `cqrun control --on`.
    """

    def __init__(
        self, figures: Sequence[Figure], size: Size, runs: Path, out: Path, minutes: float, jobs: int,
        on: str = PROCESSES,
    ) -> None:  # fmt: skip
        self.figures, self.size, self.runs, self.out, self.jobs, self.on = figures, size, runs, out, jobs, on
        self.start = time.monotonic()
        self.deadline = self.start + 60.0 * minutes
        self.errors: list[str] = []
        self._tasks: dict[str, Task] = {}
        """The tasks that are not done, by name. Figures may share them."""
        self._awaited: dict[str, set[str]] = {}
        """For each figure that is not published yet, by id: the names of its tasks that have not ended."""

    def run(self) -> int:
        """Do it; return 0 if all is done, 75 if the time is over, or 1 after errors, which stop no other figure."""
        for figure in self.figures:
            try:
                self._prepare(figure)
            except Exception as error:  # a file of a task is damaged, or another engine has to continue it
                self._report_error(figure.id, error)
        left = duration(self._left(self._tasks.values()))
        print(f"{len(self.figures)} figures, size {self.size}: about {left} of work left on two cores")
        self._publish_ended()
        try:
            complete = self._do_tasks()
        except SystemExit:
            print("stopped: the same command continues", flush=True)
            raise
        if not complete:
            print("not everything is done: the same command continues")
        if self.errors:
            print("errors:", *dict.fromkeys(self.errors), sep="\n  ")
        print(f"time: {duration((time.monotonic() - self.start) / 60.0)}")
        return FAILED if self.errors else 0 if complete else STOPPED

    def _prepare(self, figure: Figure) -> None:
        """Unpack the archives of a figure's tasks, and add the tasks that are not done."""
        tasks = figure.tasks(self.size)
        for task in tasks:
            unpack(task, self.runs, archive_path(task, self.out / self.size))
        missing = {task.name: task for task in tasks if not self._is_done(task)}
        for task in missing.values():
            task.spent(self.runs / task.name)  # raises an error if its clock is damaged
        self._awaited[figure.id] = set(missing)
        self._tasks = missing | self._tasks

    def _do_tasks(self) -> bool:
        """Do the tasks, and publish figures whose tasks have ended; return whether all is done."""
        complete = True
        for task, outcome in schedule(list(self._tasks.values()), self.jobs, self._do):
            if isinstance(outcome, Exception):
                self._report_error(next(name for name, tasks in self._awaited.items() if task.name in tasks), outcome)
            complete &= outcome is True
            for tasks in self._awaited.values():
                tasks.discard(task.name)
            self._publish_ended()
        return complete

    def _do(self, task: Task, share: float) -> bool:
        """Do a task, if there is time; return whether it is finished."""
        seconds = self.deadline - time.monotonic()
        if seconds <= 0.0:
            return False
        print(f"    {task.name}: starts (about {duration(self._left([task]) / share)})", flush=True)
        return task.do(self.runs / task.name, seconds, self.jobs, share, self.on)

    def _publish_ended(self) -> None:
        """Publish the figures whose tasks have all ended."""
        for figure in self.figures:
            if self._awaited.get(figure.id) != set():
                continue
            del self._awaited[figure.id]
            k = len(self.figures) - len(self._awaited)
            left = duration(self._left(self._tasks.values()))
            print(f"[{k}/{len(self.figures)}] {figure.id}: {figure.title} ({left} left in all)", flush=True)
            try:
                publish_progress(Publication(figure, self.size, self.out), self.runs)
            except Exception as error:
                self._report_error(figure.id, error)

    def _report_error(self, name: str, error: Exception) -> None:
        """Print and keep an error of a figure; the other figures continue, even if it is our own fault."""
        text = f"{name}: {error}"
        if not isinstance(error, CqrunError):
            last = traceback.extract_tb(error.__traceback__)[-1]
            text = f"{name}: {type(error).__name__}: {error} ({last.filename}:{last.lineno})"
        print(f"    error: {text}", flush=True)
        self.errors.append(text)

    def _is_done(self, task: Task) -> bool:
        return task.done(self.runs / task.name) is not None

    def _left(self, tasks: Iterable[Task]) -> float:
        """Return an estimate of the minutes that tasks still take."""
        return sum(task.left(self.runs / task.name) for task in tasks if not self._is_done(task))


def publish_progress(publication: Publication, runs: Path) -> None:
    """Publish a figure, unless more of it is published already; pack the tasks that are to continue."""
    tasks = publication.figure.tasks(publication.size)
    is_whole = all(task.done(runs / task.name) is not None for task in tasks)
    record = None if is_whole else publication.record()  # all tasks done replace even a damaged record
    if publication.is_complete(record):
        print("    the published figure is complete, and stays", flush=True)
        return
    verdict = None
    if record is not None and (reason := _stays(record, tasks, runs)):
        print(f"    the published figure {reason}", flush=True)
        # notes beside the runs how whole moving bodies stay, because motions are not packed
        attempt(False, publication.figure.table, begun_folders(tasks, runs), publication.size)
    else:
        verdict = publication.publish(runs)
    if verdict is not None:
        print(f"    {publication.size}: {verdict}", flush=True)
    elif is_whole:
        print(f"    there is nothing to show: see {', '.join(str(runs / task.name) for task in tasks)}", flush=True)
    for task in tasks:
        archive = archive_path(task, publication.out / publication.size)
        if is_whole and verdict is not None:
            archive.unlink(missing_ok=True)
        else:
            pack(task, runs, archive)


def _stays(record: Record, tasks: Sequence[Task], runs: Path) -> str:
    """Return why a published figure stays although its tasks go on, or an empty text if it does not stay."""
    published, of = record.done
    if published == of:
        return "is complete, but of tasks that have changed: it stays until the new ones are done"
    minutes = sum(task.minutes for task in record.tasks.values())
    minutes_now = sum(task.spent(runs / task.name) for task in tasks) / 60.0
    done_now = sum(task.done(runs / task.name) is not None for task in tasks)
    if (published, minutes) <= (done_now, minutes_now):
        return ""
    return (
        f"has {published} of {of} tasks done in {duration(minutes)}: it stays until there is more; "
        f"here {done_now} are done in {duration(minutes_now)}"
    )

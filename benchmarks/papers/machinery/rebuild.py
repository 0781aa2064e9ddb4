"""Do the work behind figures, and publish each figure when its work has ended."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.papers.figure import Figure, Size
from benchmarks.papers.machinery.archive import archive_of, keep, restore
from benchmarks.papers.machinery.process import FAILED, STOPPED
from benchmarks.papers.machinery.publish import begun, is_complete, publish, published, so_far
from benchmarks.papers.machinery.scheduler import in_turn
from benchmarks.papers.machinery.work import Work, WorkError, span
from cqrun.errors import CqrunError


class Rebuild:
    """What is missing of figures, done in turn.

    Args:
        figures: in the order in which they are begun.
        size: of their work.
        runs: holds the folders of the work of this size.
        out: results/figures.
        minutes: that there are; what is left goes on later.
        jobs: runs side by side.
    """

    def __init__(self, figures: Sequence[Figure], size: Size, runs: Path, out: Path, minutes: float, jobs: int) -> None:
        self.figures, self.size, self.runs, self.out, self.jobs = figures, size, runs, out, jobs
        self.begun = time.monotonic()
        self.end = self.begun + 60.0 * minutes
        self.errors: list[str] = []
        self._works: dict[str, Work] = {}
        """What is to be done, by its name: figures may share it."""
        self._awaited: dict[str, set[str]] = {}
        """The names of work that figures, by their id, wait for."""
        self._elsewhere: dict[str, str] = {}
        """Why figures, by their id, are left out: another engine has to go on with them."""

    def run(self) -> int:
        """Do it; return 0, 75 (no more time) or 1 (errors, which end no other figure)."""
        self._prepare()
        self._show_ended()
        try:
            complete = self._work()
        except SystemExit:
            print("stopped: the same command goes on", flush=True)
            raise
        if not complete:
            print("not all is done: the same command goes on")
        if self.errors:
            print("what could not be done or shown:", *dict.fromkeys(self.errors), sep="\n  ")
        print(f"that took {span((time.monotonic() - self.begun) / 60.0)}")
        return FAILED if self.errors else 0 if complete else STOPPED

    def _work(self) -> bool:
        """Do the work in turn, and show what has ended; say whether all is finished."""
        complete = True
        for work, outcome in in_turn(list(self._works.values()), self.jobs, self._do):
            if isinstance(outcome, Exception):
                self._tell(next(name for name, works in self._awaited.items() if work.name in works), outcome)
            complete &= outcome is True
            for works in self._awaited.values():
                works.discard(work.name)
            self._show_ended()
        return complete

    def _prepare(self) -> None:
        """Find what is to be done; unpack what was begun elsewhere."""
        for figure in self.figures:
            try:
                self._await(figure)
            except Exception as error:  # a damaged file of its work
                self._tell(figure.id, error)
        self.errors += self._elsewhere.values()
        print(f"{len(self.figures)} figures, size {self.size}: about {span(self._left())} of work left on two cores")

    def _await(self, figure: Figure) -> None:
        """Find what is to be done for a figure."""
        works = figure.work(self.size)
        for work in works:
            if told := self._restored(work):
                self._elsewhere[figure.id] = told
        todo = [work for work in works if figure.id not in self._elsewhere and not self._is_done(work)]
        for work in todo:
            work.spent(self.runs / work.name)  # raises where its clock cannot be read
        self._awaited[figure.id] = {work.name for work in todo}
        self._works |= {work.name: work for work in todo if work.name not in self._works}

    def _restored(self, work: Work) -> str:
        """Unpack work that was begun elsewhere; return why it cannot be, if it cannot."""
        try:
            restore(work, self.runs, archive_of(work, self.out / self.size))
        except WorkError as error:
            return str(error)
        return ""

    def _do(self, work: Work, share: float) -> bool:
        """Do some work, if there is time; say whether it is finished."""
        seconds = self.end - time.monotonic()
        if seconds <= 0.0:
            return False
        print(f"    {work.name}: begins (about {span(self._left([work]) / share)})", flush=True)
        return work.do(self.runs / work.name, seconds, self.jobs, share)

    def _show_ended(self) -> None:
        """Publish the figures of which no work is awaited any more."""
        for figure in self.figures:
            if self._awaited.get(figure.id) != set():
                continue
            del self._awaited[figure.id]
            k = len(self.figures) - len(self._awaited)
            left = span(self._left())
            print(f"[{k}/{len(self.figures)}] {figure.id}: {figure.title} ({left} left in all)", flush=True)
            if figure.id in self._elsewhere:
                print(f"    left out: {self._elsewhere[figure.id]}", flush=True)
                continue
            try:
                show(figure, self.size, self.runs, self.out)
            except Exception as error:
                self._tell(figure.id, error)

    def _tell(self, name: str, error: Exception) -> None:
        """Tell and keep what goes wrong with a figure, be it a fault of ours: the others go on."""
        place = "" if isinstance(error, CqrunError) else f" ({_line(error)})"
        told = f"{name}: {'' if place == '' else f'{type(error).__name__}: '}{error}{place}"
        print(f"    error: {told}", flush=True)
        self.errors.append(told)

    def _is_done(self, work: Work) -> bool:
        return work.done(self.runs / work.name) is not None

    def _left(self, works: Iterable[Work] | None = None) -> float:
        """Return the minutes that work still takes."""
        return sum(
            work.left(self.runs / work.name)
            for work in (self._works.values() if works is None else works)
            if not self._is_done(work)
        )


def show(figure: Figure, size: Size, runs: Path, out: Path) -> None:
    """Publish a figure, but never less of it over more, be that of work that has changed; keep what goes on."""
    works = figure.work(size)
    is_whole = all(work.done(runs / work.name) is not None for work in works)
    record = None if is_whole else published(figure, size, out)  # a whole replaces even one that cannot be read
    if record is not None and is_complete(figure, size, record):
        print("    what is published is complete, and stays", flush=True)
        return
    verdict = None
    if record is not None and (why := _outweighs(record, works, runs)):
        print(f"    what is published {why}", flush=True)
        so_far(lambda: figure.table(begun(figure, size, runs), size))  # notes of motions, which are not packed
    else:
        verdict = publish(figure, size, runs, out)
    if verdict is not None:
        print(f"    {size}: {verdict}", flush=True)
    elif is_whole:
        print(f"    nothing to show came of it: see {', '.join(str(runs / work.name) for work in works)}", flush=True)
    for work in works:
        archive = archive_of(work, out / size)
        if is_whole and verdict is not None:
            archive.unlink(missing_ok=True)
        else:
            keep(work, runs, archive)


def _outweighs(record: dict[str, Any], works: Sequence[Work], runs: Path) -> str:
    """Return why what was published stays beside a part of the work; empty if it does not."""
    if record["done"][0] == record["done"][1]:
        return "is of other work, but whole: it stays until this is"
    before = sum(work["minutes"] for work in record["works"].values())
    now = sum(work.spent(runs / work.name) for work in works) / 60.0
    done = sum(work.done(runs / work.name) is not None for work in works)
    if (record["done"][0], before) <= (done, now):
        return ""
    told = f"has {record['done'][0]} of {record['done'][1]} parts of the work done, {span(before)}"
    return f"{told}: it stays until there is more, and here are {done} done, {span(now)}"


def _line(error: Exception) -> str:
    """Return where an error arose."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{last.filename}:{last.lineno}"

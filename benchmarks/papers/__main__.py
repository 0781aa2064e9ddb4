"""python -m benchmarks.papers [--size quick|paper] [--only ID ...] [--minutes N] [--list] [--judge] [--page]

Do what is missing, go on with what was stopped, skip what is done; then write each figure's CSV, PNG, PDF and verdict
to results/figures/SIZE, and results/figures/index.html. What a figure that is not complete needs to go on, here or on
another machine, is left in results/figures/SIZE/unfinished; `--minutes 0` does nothing else. It goes on with the engine
that it was begun with, which the figure's JSON names.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import Figure, Size
from benchmarks.papers.kept import archive_of, keep, restore
from benchmarks.papers.page import write_page
from benchmarks.papers.publish import is_complete, publish, publish_again, published
from benchmarks.papers.work import ROOT, Work, WorkError, span
from cqrun.errors import CqrunError
from cqrun.store.atomic import make_directory

FIGURES_DIR = ROOT / "results" / "figures"


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status: 0 all done, 75 out of time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=[size.value for size in Size], default=Size.QUICK.value)
    parser.add_argument("--only", action="extend", nargs="+", choices=list(FIGURES), metavar="ID")
    parser.add_argument(
        "--minutes", type=_minutes, default=float("inf"), help="stop after so long; the rest goes on later"
    )
    parser.add_argument("--jobs", type=_count, default=2, help="runs side by side")
    parser.add_argument("--runs", type=Path, default=ROOT / "results" / "papers", help="where the runs are kept")
    parser.add_argument("--out", type=Path, default=FIGURES_DIR, help="where the figures go")
    parser.add_argument("--list", action="store_true", help="list the figures and how long they take")
    parser.add_argument(
        "--judge", action="store_true", help="only draw and judge anew what was published, from its CSV"
    )
    parser.add_argument("--page", action="store_true", help="only write index.html, from what was published")
    options = parser.parse_args(words)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))  # so that runs are asked to stop, too
    chosen, size = [FIGURES[name] for name in options.only or FIGURES], Size(options.size)
    try:
        if not options.list:
            for folder in (options.out / size, options.runs / size):
                make_directory(folder)
        return _run(chosen, size, options)
    except CqrunError as error:
        parser.exit(2, f"error: {error}\n")


def _run(chosen: Sequence[Figure], size: Size, options: argparse.Namespace) -> int:
    """Do what the options say; return the exit status."""
    if options.list:
        _list(chosen, options.runs, options.out)
        return 0
    if options.judge:
        for figure in chosen:
            if (verdict := publish_again(figure, size, options.out)) is not None:
                print(f"{figure.id}, {size}: {verdict}")
    status = 0 if options.page or options.judge else _do(chosen, size, options)
    page = write_page(options.out)
    print(f"\n{page}")
    return status


def _minutes(word: str) -> float:
    """Return a number of minutes, 0 or more."""
    if not (minutes := float(word)) >= 0.0:
        raise ValueError
    return minutes


def _count(word: str) -> int:
    """Return a whole number from 1 on."""
    if (count := int(word)) < 1:
        raise ValueError
    return count


_minutes.__name__, _count.__name__ = "number of minutes", "whole number from 1 on"  # as argparse says it


def _do(figures: Sequence[Figure], size: Size, options: argparse.Namespace) -> int:
    """Do the work of figures until the time is over, and publish each; return 0, 75 (no more time) or 1 (error)."""
    runs, folder = options.runs / size, options.out / size
    end = time.monotonic() + 60.0 * options.minutes
    elsewhere = {
        figure.id: told for figure in figures for work in figure.work(size) if (told := _restored(work, runs, folder))
    }
    errors = list(elsewhere.values())
    works = {work.name: work for figure in figures for work in figure.work(size)}
    left = sum(_left(work, runs) for work in works.values())
    print(f"{len(figures)} figures, size {size}: about {span(left)} of work left on two cores")
    complete = True
    for k, figure in enumerate(figures, start=1):
        todo = [work for work in figure.work(size) if work.done(runs / work.name) is None]
        about = sum(_left(work, runs) for work in todo)
        told = f"about {span(about)}" if todo else "done"
        print(f"[{k}/{len(figures)}] {figure.id}: {figure.title} ({told}; {span(left)} left in all)", flush=True)
        left -= about
        if figure.id in elsewhere:
            print(f"    left out: {elsewhere[figure.id]}", flush=True)
            continue
        for work in todo:
            with _told(figure, errors):
                complete &= (seconds := end - time.monotonic()) > 0.0 and work.do(
                    runs / work.name, seconds, options.jobs
                )
        with _told(figure, errors):
            _show(figure, size, runs, options.out)
    if not complete:
        print("not all is done: the same command goes on")
    if errors:
        print("what could not be done or shown:", *dict.fromkeys(errors), sep="\n  ")
    return 1 if errors else 0 if complete else 75


@contextmanager
def _told(figure: Figure, errors: list[str]) -> Iterator[None]:
    """Tell and keep what goes wrong with a figure, be it a fault of ours: the others go on."""
    try:
        yield
    except Exception as error:
        place = "" if isinstance(error, CqrunError) else f" ({_line(error)})"
        told = f"{figure.id}: {'' if place == '' else f'{type(error).__name__}: '}{error}{place}"
        print(f"    error: {told}", flush=True)
        errors.append(told)


def _line(error: Exception) -> str:
    """Return where an error arose."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{last.filename}:{last.lineno}"


def _restored(work: Work, runs: Path, folder: Path) -> str:
    """Unpack work that was begun elsewhere; return why it cannot be, if it cannot."""
    try:
        restore(work, runs, archive_of(work, folder))
    except WorkError as error:
        return str(error)
    return ""


def _show(figure: Figure, size: Size, runs: Path, out: Path) -> None:
    """Publish a figure, but never a part of it over the whole; keep what it needs to go on."""
    works = figure.work(size)
    is_whole = all(work.done(runs / work.name) is not None for work in works)
    if not is_whole and is_complete(figure, size, published(figure, size, out)):
        print("    what is published is complete, and stays", flush=True)
        return
    verdict = publish(figure, size, runs, out)
    if verdict is not None:
        print(f"    {size}: {verdict}", flush=True)
    _keep(works, runs, out / size, shown=verdict is not None)


def _keep(works: Sequence[Work], runs: Path, folder: Path, *, shown: bool) -> None:
    """Leave what a figure needs to go on, or remove that when it is complete and shown."""
    complete = all(work.done(runs / work.name) is not None for work in works)
    if complete and not shown:
        print(f"    nothing to show came of it: see {', '.join(str(runs / work.name) for work in works)}", flush=True)
    complete = complete and shown
    for work in works:
        archive = archive_of(work, folder)
        if complete:
            archive.unlink(missing_ok=True)
        else:
            keep(work, runs, archive)


def _left(work: Work, runs: Path) -> float:
    """Return the minutes that some work still takes, at least a tenth of all while it is not done."""
    folder = runs / work.name
    if work.done(folder) is not None:
        return 0.0
    return max(0.1 * work.minutes, work.minutes - work.spent(folder) / 60.0)


def _list(figures: Sequence[Figure], runs: Path, out: Path) -> None:
    for figure in figures:
        print(f"{figure.id:<24} {figure.source:<18} {figure.title}")
        for size in Size:
            works = figure.work(size)
            done = sum(work.done(runs / size / work.name) is not None for work in works)
            minutes = sum(work.minutes for work in works)
            record = published(figure, size, out)
            told = f"published: {record['verdict']}" if record is not None else "not published"
            names = "; ".join(work.name for work in works)
            print(f"    {size:<6} {span(minutes):>8}, {told}; {done} of {len(works)} done here: {names}")


if __name__ == "__main__":
    sys.exit(main())

"""python -m benchmarks.papers [--size quick|paper] [--only ID ...] [--minutes N] [--list] [--judge] [--page]

Do what is missing, go on with what was stopped, skip what is done; then write each figure's CSV, PNG, PDF and verdict
to results/figures/SIZE, and results/figures/index.html. What a figure that is not complete needs to go on, here or on
another machine, is left in results/figures/SIZE/unfinished; `--minutes 0` does nothing else. It goes on with the engine
that it was begun with, which the figure's JSON names.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import Figure, Size
from benchmarks.papers.machinery.page import write_page
from benchmarks.papers.machinery.process import FAILED, ROOT, STOPPED
from benchmarks.papers.machinery.publish import is_complete, publish_again, published, shown
from benchmarks.papers.machinery.rebuild import Rebuild
from benchmarks.papers.machinery.work import WorkError, span
from cqrun.errors import CqrunError, UsageError
from cqrun.store.atomic import make_directory

FIGURES_DIR = ROOT / "results" / "figures"


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status: 0 all done, 75 out of time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=[size.value for size in Size], default=Size.QUICK.value)
    parser.add_argument("--only", action="extend", nargs="+", choices=list(FIGURES), metavar="ID")
    parser.add_argument(
        "--minutes",
        type=_minutes,
        default=float("inf"),
        help="stop after so long (and two minutes at most for what is begun); the rest goes on later",
    )
    parser.add_argument("--jobs", type=_count, default=2, help="runs side by side")
    parser.add_argument("--runs", type=Path, default=ROOT / "results" / "papers", help="where the runs are kept")
    parser.add_argument("--out", type=Path, default=FIGURES_DIR, help="where the figures go")
    parser.add_argument("--unpublished", action="store_true", help="leave out what is published whole in --out")
    parser.add_argument("--list", action="store_true", help="list the figures and how long they take")
    parser.add_argument(
        "--judge", action="store_true", help="only draw and judge anew what was published, from its CSV"
    )
    parser.add_argument("--page", action="store_true", help="only write index.html, from what was published")
    options = parser.parse_args(words)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(STOPPED))  # so that runs are asked to stop, too
    chosen, size = [FIGURES[name] for name in options.only or FIGURES], Size(options.size)
    try:
        if options.unpublished:
            chosen = [figure for figure in chosen if not _is_published(figure, size, options.out)]
        if not options.list:
            make_directory(options.out / size)
            _make_runs(options.runs / size)
        return _run(chosen, size, options)
    except CqrunError as error:
        parser.exit(2, f"error: {error}\n")
    except BrokenPipeError:  # `--list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _is_published(figure: Figure, size: Size, out: Path) -> bool:
    """Say whether a figure is published whole; one that cannot be read is not."""
    try:
        return is_complete(figure, size, shown(figure, size, out))
    except WorkError:
        return False


def _make_runs(folder: Path) -> None:
    try:
        make_directory(folder)
    except CqrunError as error:
        raise UsageError(str(error).replace("--out", "--runs")) from error


def _run(chosen: Sequence[Figure], size: Size, options: argparse.Namespace) -> int:
    """Do what the options say; return the exit status."""
    if options.list:
        _list(chosen, options.runs, options.out)
        return 0
    status = 0
    for figure in chosen if options.judge else ():
        try:
            if (verdict := publish_again(figure, size, options.out)) is not None:
                print(f"{figure.id}, {size}: {verdict}")
        except WorkError as error:  # the others are judged
            print(f"{figure.id}, {size}: error: {error}")
            status = FAILED
    if not (options.page or options.judge):
        status = Rebuild(chosen, size, options.runs / size, options.out, options.minutes, options.jobs).run()
    damaged = write_page(options.out)
    print(f"\n{options.out / 'index.html'}", *damaged, sep="\n")
    return status or (FAILED if damaged else 0)


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


def _list(figures: Sequence[Figure], runs: Path, out: Path) -> None:
    for figure in figures:
        print(f"{figure.id:<24} {figure.source:<18} {figure.title}")
        for size in Size:
            works = figure.work(size)
            done = sum(work.done(runs / size / work.name) is not None for work in works)
            minutes = sum(work.minutes for work in works)
            told = _told_of(figure, size, out)
            names = "; ".join(work.name for work in works)
            print(f"    {size:<6} {span(minutes):>8}, {told}; {done} of {len(works)} done here: {names}")


def _told_of(figure: Figure, size: Size, out: Path) -> str:
    try:
        record = published(figure, size, out)
    except WorkError as error:
        return str(error)
    return "not published" if record is None else f"published: {record['verdict']}"


if __name__ == "__main__":
    sys.exit(main())

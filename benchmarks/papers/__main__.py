"""python -m benchmarks.papers [--size quick|paper] [--only ID ...] [--minutes N] [--on PLACE]
                            [--list] [--judge] [--page]

Do the tasks that are missing, continue those that were stopped, and skip those that are done. Then write each figure's
CSV, PNG, PDF and verdict to results/figures/SIZE, and results/figures/index.html. What an unfinished figure needs to
continue, here or on another machine, is packed into results/figures/SIZE/unfinished; `--minutes 0` only packs. An
unfinished task continues only with the engine that began it; the figure's JSON names that engine.
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
from benchmarks.papers.machinery.process import FAILED, ROOT, STOPPED, USAGE
from benchmarks.papers.machinery.publish import Publication
from benchmarks.papers.machinery.rebuild import Rebuild
from benchmarks.papers.machinery.task import TaskError, duration
from cqrun.errors import CqrunError, UsageError
from cqrun.running.cluster import PROCESSES, require_place
from cqrun.store.atomic import make_directory

RESULTS = ROOT / "results"


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status: 0 if all is done, 75 if the time is over, 1 after errors."""
    options = _options(words)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(STOPPED))  # so that running commands are asked to stop, too
    size = Size(options.size)
    publications = [Publication(FIGURES[name], size, options.out) for name in options.only or FIGURES]
    try:
        require_place(options.on)
        if options.unpublished:
            publications = [each for each in publications if not _is_published(each)]
        if options.list:
            _list([each.figure for each in publications], options.runs, options.out)
            return 0
        make_directory(options.out / size)
        _make_runs(options.runs / size)
        return _run(publications, size, options)
    except CqrunError as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE
    except BrokenPipeError:  # `--list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; exit with a message if one is not valid."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.papers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--size", choices=[size.value for size in Size], default=Size.QUICK.value)
    add("--only", action="extend", nargs="+", choices=list(FIGURES), metavar="ID", help="these figures only")
    stop = "stop after so many minutes (a run may need two more to finish its iteration); the rest continues later"
    add("--minutes", type=float, default=float("inf"), help=stop)
    add("--jobs", type=int, default=2, help="runs side by side")
    place = "where seeds and variants run: processes (here), dask, dask://HOST:PORT or slurm; all else runs here"
    add("--on", default=PROCESSES, metavar="PLACE", help=place)
    add("--runs", type=Path, default=RESULTS / "papers", help="the folder of the runs")
    add("--out", type=Path, default=RESULTS / "figures", help="the folder of the figures")
    add("--unpublished", action="store_true", help="skip figures that are complete in --out")
    add("--list", action="store_true", help="list the figures and how long they take")
    add("--judge", action="store_true", help="only draw and judge published figures again, from their CSV")
    add("--page", action="store_true", help="only write index.html and README.md, from published figures")
    options = parser.parse_args(words)
    if not options.minutes >= 0.0 or options.jobs < 1:
        parser.error("--minutes has to be 0 or more, and --jobs 1 or more")
    return options


def _is_published(publication: Publication) -> bool:
    """Return whether a figure is published completely; a damaged one is not."""
    try:
        verified = publication.verified()
    except TaskError:
        return False
    return verified is not None and publication.is_complete(verified[0])


def _make_runs(folder: Path) -> None:
    try:
        make_directory(folder)
    except CqrunError as error:
        raise UsageError(str(error).replace("--out", "--runs")) from error


def _run(publications: Sequence[Publication], size: Size, options: argparse.Namespace) -> int:
    """Do what the options say; return the exit status."""
    status = 0
    if options.judge:
        status = _judge_again(publications)
    elif not options.page:
        figures = [each.figure for each in publications]
        status = Rebuild(
            figures, size, options.runs / size, options.out, options.minutes, options.jobs, options.on
        ).run()
    damaged = write_page(FIGURES.values(), options.out)
    print(f"\n{options.out / 'index.html'}", *damaged, sep="\n")
    return status or (FAILED if damaged else 0)


def _judge_again(publications: Sequence[Publication]) -> int:
    """Draw and judge published figures again; return the exit status."""
    status = 0
    for each in publications:
        try:
            if (verdict := each.judge_again()) is not None:
                print(f"{each.figure.id}, {each.size}: {verdict}")
        except TaskError as error:  # the others are judged
            print(f"{each.figure.id}, {each.size}: error: {error}")
            status = FAILED
    return status


def _list(figures: Sequence[Figure], runs: Path, out: Path) -> None:
    for figure in figures:
        print(f"{figure.id:<24} {figure.source:<18} {figure.title}")
        for size in Size:
            tasks = figure.tasks(size)
            done = sum(task.done(runs / size / task.name) is not None for task in tasks)
            minutes = duration(sum(task.minutes for task in tasks))
            state, names = _state(Publication(figure, size, out)), "; ".join(task.name for task in tasks)
            print(f"    {size:<6} {minutes:>8}, {state}; {done} of {len(tasks)} tasks done here: {names}")


def _state(publication: Publication) -> str:
    try:
        record = publication.record()
    except TaskError as error:
        return str(error)
    return "not published" if record is None else f"published: {record.verdict}"


if __name__ == "__main__":
    sys.exit(main())

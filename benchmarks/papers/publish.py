"""From the work's folders to what is committed in results/figures/SIZE: CSV, PNG, PDF, a record with the verdict."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.papers.figure import Figure, Judgement, Size, Table, Verdict, judged, read_table, write_table
from cqrun.figures.style import save, styled
from cqrun.store.atomic import make_directory, write_json

KINDS = ("png", "pdf")
T = TypeVar("T")


def publish(figure: Figure, size: Size, runs: Path, out: Path) -> Verdict | None:
    """Write what a figure's work has shown so far; return the verdict, or None if there is nothing yet.

    Args:
        runs: holds the folders of the work of this size.
        out: results/figures.
    """
    works = figure.work(size)
    found = {work.name: runs / work.name for work in works if work.begun(runs / work.name)}
    done = {work.name: facts for work in works if (facts := work.done(runs / work.name)) is not None}
    complete = len(done) == len(works)
    table = figure.table(found, size) if complete else so_far(lambda: figure.table(found, size)) if found else None
    if not table or not len(next(iter(table.values()))):
        return None
    folder = out / size
    make_directory(folder)
    write_table(table, folder / f"{figure.id}.csv")
    table = read_table(folder / f"{figure.id}.csv")  # what is drawn and judged is what is committed
    with styled():
        picture = figure.draw(table, size, found) if complete else so_far(lambda: figure.draw(table, size, found))
        if picture is None:
            return None
        save(picture, folder / figure.id, KINDS)
    record: dict[str, Any] = {
        "done": [len(done), len(works)],
        "failed": [reason for work in works if work.name in done for reason in work.failures(runs / work.name)],
        "commands": [work.command for work in works],
        "minutes": sum(work.spent(runs / work.name) for work in works) / 60.0,
        "engine": sorted({work.engine(found[work.name]) for work in works if work.name in found}),
        "machine": next((facts["machine"] for facts in done.values()), None),
    }
    return _judge(figure, table, size, record, folder)


def so_far(do: Callable[[], T]) -> T | None:
    """Return what a figure, which is made for the whole, makes of unfinished work; None where that is too little."""
    try:
        return do()
    except (ValueError, LookupError, TypeError, StopIteration, FileNotFoundError):
        return None


def verdict_on(figure: Figure, table: Table, size: Size, record: dict[str, Any]) -> Verdict:
    """Return the verdict on a table whose work is as a record says.

    A figure of which runs failed is reproduced in part at best. One whose work is not what it was when it was done is
    unfinished, as is one that is not done.
    """
    complete = record["done"][0] == record["done"][1]
    complete = complete and record["commands"] == [work.command for work in figure.work(size)]
    found = figure.judge(table, size) if complete else so_far(lambda: figure.judge(table, size))
    checks = dict(found.checks) if found is not None else {}
    if record["failed"]:
        checks[f"no run fails ({len(record['failed'])} did: {record['failed'][0].partition(';')[0]})"] = False
        found = judged(checks)
    return found if complete and found is not None else Verdict(Judgement.UNFINISHED, checks)


def _judge(figure: Figure, table: Table, size: Size, record: dict[str, Any], folder: Path) -> Verdict:
    """Write the record with the verdict, and return that."""
    verdict = verdict_on(figure, table, size, record)
    write_json(folder / f"{figure.id}.json", {"verdict": verdict.judgement, "checks": dict(verdict.checks), **record})
    return verdict


def publish_again(figure: Figure, size: Size, out: Path) -> Verdict | None:
    """Draw and judge what was published once more, from its CSV; return the verdict, or None if there is nothing."""
    record = published(figure, size, out)
    if record is None:
        return None
    table = read_table(out / size / f"{figure.id}.csv")
    if not figure.needs_runs:
        with styled():
            save(figure.draw(table, size, {}), out / size / figure.id, KINDS)
    told = {"failed": []} | {key: value for key, value in record.items() if key not in ("verdict", "checks")}
    return _judge(figure, table, size, told, out / size)


def published(figure: Figure, size: Size, out: Path) -> dict[str, Any] | None:
    """Return the record of a figure that was published, or None."""
    file = out / size / f"{figure.id}.json"
    return json.loads(file.read_text()) if file.exists() else None

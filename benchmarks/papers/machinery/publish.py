"""From the work's folders to what is committed in results/figures/SIZE: CSV, PNG, PDF, a record with the verdict."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.papers.figure import Figure, Judgement, Size, Table, Verdict, judged, lowered, read_table, write_table
from benchmarks.papers.machinery.work import Work, WorkError
from cqrun.figures.style import save, styled
from cqrun.store.atomic import make_directory, write_json

KINDS = ("png", "pdf")
RECORDED = ("verdict", "checks", "asked", "data", "done", "failed", "works", "engine", "machines")
"""What the record of a figure has."""

T = TypeVar("T")


def publish(figure: Figure, size: Size, runs: Path, out: Path) -> Verdict | None:
    """Write what a figure's work has shown so far; return the verdict, or None if there is nothing yet.

    Args:
        runs: holds the folders of the work of this size.
        out: results/figures.
    """
    works, found = figure.work(size), begun(figure, size, runs)
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
        "works": {
            name: of | {"minutes": work.spent(runs / name) / 60.0, "remark": work.remark(runs / name)}
            for work, (name, of) in zip(works, identity(works).items(), strict=True)
        },
        "engine": sorted({work.engine(found[work.name]) for work in works if work.name in found}),
        "machines": [facts["machine"] for facts in done.values()],
    }
    return _judge(figure, table, size, record, folder)


def begun(figure: Figure, size: Size, runs: Path) -> dict[str, Path]:
    """Return the folders of a figure's work that is begun, by its name."""
    return {work.name: runs / work.name for work in figure.work(size) if work.begun(runs / work.name)}


def identity(works: Sequence[Work]) -> dict[str, dict[str, Any]]:
    """Return what work is, by its name: if that changes, what was published is of something else."""
    return {work.name: {"command": work.command, "fingerprint": work.fingerprint()} for work in works}


def is_complete(figure: Figure, size: Size, record: dict[str, Any] | None) -> bool:
    """Say whether what was published is of the whole work, as that is today."""
    if record is None or record["done"][0] < record["done"][1]:
        return False
    return is_as_asked(figure, size, record)


def is_as_asked(figure: Figure, size: Size, record: dict[str, Any]) -> bool:
    """Say whether the work of what was published, done or not, is what is asked today."""
    told = {name: {key: of[key] for key in ("command", "fingerprint")} for name, of in record["works"].items()}
    return told == identity(figure.work(size))


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
    complete = is_complete(figure, size, record)
    found = figure.judge(table, size) if complete else so_far(lambda: figure.judge(table, size))
    if record["failed"]:
        told = f"no run fails ({len(record['failed'])} did: {record['failed'][0].partition(';')[0]})"
        found = lowered(found if found is not None else judged({}), {told: False})
    if complete and found is not None:
        return found
    return Verdict(Judgement.UNFINISHED, found.checks if found is not None else {})


def _judge(figure: Figure, table: Table, size: Size, record: dict[str, Any], folder: Path) -> Verdict:
    """Write the record with the verdict, and return that."""
    verdict = verdict_on(figure, table, size, record)
    told = {"verdict": verdict.judgement, "checks": dict(verdict.checks), "asked": figure.tolerance[size]}
    write_json(folder / f"{figure.id}.json", told | {"data": _digest(folder / f"{figure.id}.csv")} | record)
    return verdict


def _digest(data: Path) -> str:
    """Return a hash of a CSV, by which another one is told."""
    return hashlib.sha256(data.read_bytes()).hexdigest()[:12]


def publish_again(figure: Figure, size: Size, out: Path) -> Verdict | None:
    """Draw and judge what was published once more, from its CSV; return the verdict, or None if there is nothing.

    Raises:
        WorkError: the CSV is not the one that was published.
    """
    record = published(figure, size, out)
    if record is None:
        return None
    table = read_table(data_of(figure, size, out, record))
    if not figure.needs_runs:
        with styled():
            save(figure.draw(table, size, {}), out / size / figure.id, KINDS)
    told = {key: value for key, value in record.items() if key not in ("verdict", "checks", "asked", "data")}
    return _judge(figure, table, size, told, out / size)


def published(figure: Figure, size: Size, out: Path) -> dict[str, Any] | None:
    """Return the record of a figure that was published, or None.

    Raises:
        WorkError: it is not JSON, or lacks what a record has.
    """
    file = out / size / f"{figure.id}.json"
    try:
        record = json.loads(file.read_text()) if file.exists() else None
    except ValueError as error:
        raise WorkError(f"{file}: not JSON ({error}); {_again(figure, size)}") from None
    if record is not None and (lacking := [key for key in RECORDED if key not in record]):
        raise WorkError(f"{file}: lacks {', '.join(lacking)}; {_again(figure, size)}")
    return record


def shown(figure: Figure, size: Size, out: Path) -> dict[str, Any] | None:
    """Return the record of a figure that was published with all that belongs to it, or None.

    Raises:
        WorkError: the record cannot be read, or the CSV or the PNG is not there or not its own.
    """
    record = published(figure, size, out)
    if record is not None:
        data_of(figure, size, out, record)
        picture_of(figure, size, out)
    return record


def data_of(figure: Figure, size: Size, out: Path, record: dict[str, Any]) -> Path:
    """Return the CSV of a figure that was published.

    Raises:
        WorkError: it is not there, or not the one that the record is of.
    """
    data = out / size / f"{figure.id}.csv"
    if not data.exists() or _digest(data) != record["data"]:
        raise WorkError(f"{data}: not the numbers that were published; {_again(figure, size)}")
    return data


def picture_of(figure: Figure, size: Size, out: Path) -> bytes:
    """Return the PNG of a figure that was published.

    Raises:
        WorkError: it is not there.
    """
    file = out / size / f"{figure.id}.png"
    if not file.exists():
        raise WorkError(f"{file}: is not there; {_again(figure, size)}")
    return file.read_bytes()


def _again(figure: Figure, size: Size) -> str:
    return f"get it back, or run `python -m benchmarks.papers --size {size} --only {figure.id}`"

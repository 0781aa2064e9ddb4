"""From the work's folders to what is committed in results/figures/SIZE: CSV, PNG, PDF, a record with the verdict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.papers.figure import Figure, Judgement, Size, Verdict, read_table, write_table
from cqrun.figures.style import save, styled
from cqrun.store.atomic import make_directory, write_json

KINDS = ("png", "pdf")


def publish(figure: Figure, size: Size, runs: Path, out: Path) -> Verdict | None:
    """Write what a figure's work has shown so far; return the verdict, or None if there is nothing yet.

    Args:
        runs: holds the folders of the work of this size.
        out: results/figures.
    """
    works = figure.work(size)
    found = {work.name: runs / work.name for work in works if work.begun(runs / work.name)}
    done = {work.name: facts for work in works if (facts := work.done(runs / work.name)) is not None}
    table = figure.table(found, size) if found else {}
    if not table or not len(next(iter(table.values()))):
        return None
    folder = out / size
    make_directory(folder)
    write_table(table, folder / f"{figure.id}.csv")
    table = read_table(folder / f"{figure.id}.csv")  # what is drawn and judged is what is committed
    with styled():
        save(figure.draw(table, size, found), folder / figure.id, KINDS)
    verdict = figure.judge(table, size)
    if len(done) < len(works):
        verdict = Verdict(Judgement.UNFINISHED, verdict.checks)
    record: dict[str, Any] = {
        "verdict": verdict.judgement,
        "checks": dict(verdict.checks),
        "done": [len(done), len(works)],
        "commands": [work.command for work in works],
        "minutes": sum(work.spent(runs / work.name) for work in works) / 60.0,
        "engine": sorted({work.engine(found[work.name]) for work in works if work.name in found}),
        "machine": next((facts["machine"] for facts in done.values()), None),
    }
    write_json(folder / f"{figure.id}.json", record)
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
    verdict = figure.judge(table, size)
    if record["done"][0] < record["done"][1]:
        verdict = Verdict(Judgement.UNFINISHED, verdict.checks)
    write_json(
        out / size / f"{figure.id}.json", record | {"verdict": verdict.judgement, "checks": dict(verdict.checks)}
    )
    return verdict


def published(figure: Figure, size: Size, out: Path) -> dict[str, Any] | None:
    """Return the record of a figure that was published, or None."""
    file = out / size / f"{figure.id}.json"
    return json.loads(file.read_text()) if file.exists() else None

"""All figures on one page, index.html, and as README.md for readers of the repository."""

from __future__ import annotations

import base64
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from benchmarks.papers.figure import NOT_PRINTED, Figure, Judgement, Size
from benchmarks.papers.machinery.publish import Publication, Record
from benchmarks.papers.machinery.task import TaskError, duration
from cqrun.store.atomic import make_directory, write_text

PAGE, GALLERY = (Path(__file__).with_name(name) for name in ("page.html.j2", "gallery.md.j2"))
STYLES = {
    Judgement.MET: "reproduced",
    Judgement.EXCEEDED: "reproduced",
    Judgement.PARTLY: "part",
    Judgement.MISSED: "missed",
    Judgement.UNFINISHED: "none",
}
"""The page's CSS class of each verdict."""

NOT_RUN, DAMAGED = "not run", "damaged"


def write_page(figures: Iterable[Figure], out: Path) -> list[str]:
    """Write index.html and README.md from what is published below `out`; return what of that is damaged."""
    rows: list[dict[str, Any]] = [
        {"figure": figure, "results": [_result(figure, size, out) for size in Size]} for figure in figures
    ]
    totals = {size.value: _total(rows, k) for k, size in enumerate(Size)}
    make_directory(out)
    for template, name in ((PAGE, "index.html"), (GALLERY, "README.md")):
        environment = Environment(
            autoescape=template is PAGE, finalize=None if template is PAGE else literal,
            undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        )  # fmt: skip
        environment.filters["code"] = code
        write_text(out / name, environment.from_string(template.read_text()).render(rows=rows, totals=totals))
    return [result["error"] for row in rows for result in row["results"] if result["error"]]


def literal(value: object) -> str:
    """Return a text as Markdown that shows it as it is, in one line, as the page in HTML does; code stays as it is."""
    if isinstance(value, Markup):
        return value
    text = " ".join(str(value).splitlines())
    text = re.sub(r"[\\`*\[\]<|&~$]|(?<![^\W_])_|_(?![^\W_])", r"\\\g<0>", text)  # _ inside a word means nothing
    return re.sub(r"^(\s*\d*)([#+=>.)-])(?=[#+=>-]*(\s|$))", r"\1\\\2", text)  # headings, lists, quotations


def code(text: str) -> Markup:
    """Return a text as code in Markdown, between more backticks than it has in a row."""
    line = " ".join(text.splitlines())
    fence = "`" * (1 + max((len(ticks) for ticks in re.findall("`+", line)), default=0))
    edge = " " if line.startswith("`") or line.endswith("`") else ""
    return Markup(f"{fence}{edge}{line}{edge}{fence}")


def _result(figure: Figure, size: Size, out: Path) -> dict[str, Any]:
    """Return what the templates show of a figure at one size."""
    publication = Publication(figure, size, out)
    empty = {"size": size.value, "verdict": NOT_RUN, "style": "none", "record": None, "error": ""}
    try:
        verified = publication.verified()
    except TaskError as error:  # the other figures are shown
        return empty | {"verdict": DAMAGED, "style": "missed", "error": str(error)}
    if verified is None:
        return empty
    record, picture = verified
    machines = {f"{machine['cores']} cores of {machine['processor']}" for machine in record.machines}
    return empty | {
        "verdict": record.verdict.value,
        "style": STYLES[record.verdict],
        "record": record,
        "picture": base64.b64encode(picture).decode(),
        "missing": _missing(record, publication.is_current(record)),
        "time": _time(record) if machines else "unfinished: these are the results so far",
        "machine": ", and ".join(sorted(machines)),
    }


def _missing(record: Record, is_current: bool) -> str:
    """Return which tasks are not done, and whether they have changed; an empty text if nothing is missing."""
    done, of = record.done
    unfinished = [f"{done} of {of} tasks are done"] if done < of else []
    return "; ".join(unfinished if is_current else [*unfinished, "the tasks have changed since"])


def _time(record: Record) -> str:
    """Return how long the tasks took, with their remarks."""
    remarks = (f" ({name}: {task.remark})" for name, task in record.tasks.items() if task.remark)
    return duration(sum(task.minutes for task in record.tasks.values())) + "".join(remarks)


def _total(rows: list[dict[str, Any]], k: int) -> str:
    """Return how often there is each verdict, for the papers' figures and for cqrun's own, and the time of all."""
    papers: list[dict[str, Any]] = []
    ours: list[dict[str, Any]] = []
    for row in rows:
        (ours if row["figure"].source == NOT_PRINTED else papers).append(row["results"][k])
    records = [result["record"] for result in papers + ours if result["record"] is not None]
    minutes = {name: task.minutes for record in records for name, task in record.tasks.items()}  # some are shared
    return f"{_counted(papers)}; cqrun's own: {_counted(ours)}; {duration(sum(minutes.values()))} of work in all"


def _counted(results: list[dict[str, Any]]) -> str:
    counts = Counter(result["verdict"] for result in results)
    names = (*(judgement.value for judgement in Judgement), DAMAGED, NOT_RUN)
    return ", ".join(f"{counts[name]} {name}" for name in names if counts[name])

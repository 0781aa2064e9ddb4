"""All figures on one self-contained page, index.html, and as README.md for who reads the repository."""

from __future__ import annotations

import base64
from collections import Counter
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import OWN, Figure, Judgement, Size
from benchmarks.papers.machinery.publish import is_as_asked, picture_of, shown
from benchmarks.papers.machinery.work import WorkError
from cqrun.store.atomic import make_directory, write_text

PAGE, GALLERY = (Path(__file__).with_name(name) for name in ("page.html.j2", "gallery.md.j2"))
KINDS = {
    Judgement.MET: "reproduced",
    Judgement.EXCEEDED: "reproduced",
    Judgement.PARTLY: "part",
    Judgement.MISSED: "missed",
    Judgement.UNFINISHED: "none",
}
"""The page's class of each verdict."""

NOTHING, DAMAGED = "not run", "damaged"


def write_page(out: Path) -> list[str]:
    """Write index.html and README.md beside what was published below `out`; return what of that is damaged."""
    rows = [_row(figure, out) for figure in FIGURES.values()]
    totals = {size.value: _total(rows, k) for k, size in enumerate(Size)}
    make_directory(out)
    for template, name in ((PAGE, "index.html"), (GALLERY, "README.md")):
        environment = Environment(
            autoescape=template is PAGE, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
        )
        write_text(out / name, environment.from_string(template.read_text()).render(rows=rows, totals=totals))
    return [result["error"] for row in rows for result in row["results"] if result["error"]]


def _row(figure: Figure, out: Path) -> dict[str, Any]:
    return {
        "id": figure.id,
        "source": figure.source,
        "title": figure.title,
        "paper": figure.paper,
        "left_open": figure.left_open,
        "results": [_result(figure, size, out) for size in Size],
    }


def _result(figure: Figure, size: Size, out: Path) -> dict[str, Any]:
    try:
        record = shown(figure, size, out)
    except WorkError as error:  # the other figures are shown
        return _empty(size, DAMAGED, "missed", str(error))
    if record is None:
        return _empty(size, NOTHING, "none", "")
    minutes = {name: work["minutes"] for name, work in record["works"].items()}
    machines = {f"{machine['cores']} cores of {machine['processor']}" for machine in record["machines"]}
    judgement = Judgement(record["verdict"])
    return {
        "size": size.value,
        "verdict": judgement.value,
        "kind": KINDS[judgement],
        "picture": base64.b64encode(picture_of(figure, size, out)).decode(),
        "error": "",
        "checks": record["checks"],
        "done": _done(record, is_as_asked(figure, size, record)),
        "asked": record["asked"],
        "time": _time(sum(minutes.values())) + _remarks(record) if machines else "shown is what there is so far",
        "works": minutes,
        "machine": ", and ".join(sorted(machines)),
        "engine": ", ".join(record["engine"]),
        "commands": [work["command"] for work in record["works"].values()],
    }


def _empty(size: Size, verdict: str, kind: str, error: str) -> dict[str, Any]:
    return {"size": size.value, "verdict": verdict, "kind": kind, "picture": "", "works": {}, "error": error}


def _done(record: dict[str, Any], as_asked: bool) -> str:
    """Return how much of the work is done, if not all is, and whether it is the work that is asked today."""
    done, whole = record["done"]
    told = [f"{done} of {whole} parts of the work are done"] if done < whole else []
    return "; ".join(told if as_asked else [*told, "what is asked has changed since"])


def _remarks(record: dict[str, Any]) -> str:
    """Return what is to be said beside the time."""
    told = (f"{name}: {work['remark']}" for name, work in record["works"].items() if work.get("remark"))
    return "".join(f" ({each})" for each in told)


def _time(minutes: float) -> str:
    if minutes < 1 / 60:
        return "under a second"
    return (
        f"{60 * minutes:.0f} s" if minutes < 2 else f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
    )


def _total(rows: list[dict[str, Any]], size: int) -> str:
    """Return how many verdicts of each kind there are, the papers' first, and how much work it was."""
    papers, own = ([row["results"][size] for row in rows if (row["source"] == OWN) is ours] for ours in (False, True))
    works = {name: minutes for result in papers + own for name, minutes in result["works"].items()}  # some are shared
    return f"{_counted(papers)}; cqrun's own: {_counted(own)}; {_time(sum(works.values()))} of work in all"


def _counted(results: list[dict[str, Any]]) -> str:
    counts = Counter(result["verdict"] for result in results)
    names = (*(judgement.value for judgement in Judgement), DAMAGED, NOTHING)
    return ", ".join(f"{counts[name]} {name}" for name in names if counts[name])

"""Section: the quantities that the scene measures, at the start and the end of a run, and their extremes."""

from __future__ import annotations

from collections.abc import Iterator

from cqrun.report.blocks import Block, Table
from cqrun.report.subject import Subject
from cqrun.report.words import short
from cqrun.store.measured import TABLE


def quantities(subject: Subject) -> Iterator[Block]:
    """Yield a row for each number of the measured quantities."""
    measured = getattr(subject.run.result, "measured", {})
    rows = [
        (name, "" if m.unit == "1" else m.unit, *map(short, (m.start, m.end, m.least, m.largest, m.mean)))
        for name, m in measured.items()
    ]
    if rows:
        head = ("quantity", "unit", "at the start", "at the end", "least", "largest", "mean")
        yield Table(head, rows, f"{TABLE} has them at every control step, or at every point of a path")

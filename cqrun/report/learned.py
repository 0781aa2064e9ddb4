"""What was learned by control or co-design: terms before and after, constraints, and the unknowns of the design."""

from __future__ import annotations

from collections.abc import Iterator

from cqrun.figures.quantities import labels, shown_unit
from cqrun.learning.description import constraint_cells
from cqrun.learning.learned import STAGES
from cqrun.report.blocks import Block, Number, Numbers, Table, Text
from cqrun.report.subject import Subject
from cqrun.report.words import joined, short, spread
from cqrun.store.result import Designed, LearnedResult

MOST_IN_FRONT = 4
"""Unknowns in large type, at most."""


def learned(subject: Subject, result: LearnedResult) -> Iterator[Block]:
    """Yield the loss before and after, terms, constraints and unknowns."""
    stages = result.stages()
    if not stages:
        yield Text("No episode was finished.")
        return
    names = dict(zip(result.unknowns, labels(list(result.unknowns), subject.run.scene.dim), strict=True))
    numbers = [Number(f"Loss {STAGES[name]}", short(stage.loss)) for name, stage in stages.items()]
    for name, value in list(result.constraints.items())[:2]:
        met = "met" if value.violation == 0 else f"violated by {short(value.violation)}"
        numbers.append(Number(f"Constraint {name}", short(value.value), met))
    for path, unknown in list(result.unknowns.items())[:MOST_IN_FRONT]:
        _, unit, before, after, *_ = _row(subject, names[path], path, unknown)
        numbers.append(Number(names[path], joined(after, unit.strip("-")), f"{before} before"))
    yield Numbers(numbers)
    terms = next(iter(stages.values())).terms
    rows = [(term, *(short(stage.terms[term]) if term in stage.terms else "-" for stage in stages.values()))
            for term in terms]  # fmt: skip
    rows.append(("loss", *(short(stage.loss) for stage in stages.values())))
    yield Table(("term", *(STAGES[name] for name in stages)), rows, "Means over the episodes")
    if result.constraints:
        cells = [(name, *constraint_cells(value)) for name, value in result.constraints.items()]
        width = max(map(len, cells))
        head = ("constraint", "wanted", *(["before"] if width == 5 else []), "learned", "violated by")
        yield Table(head, [row if len(row) == width else (*row[:2], "-", *row[2:]) for row in cells])
    if result.unknowns:
        yield Table(
            ("unknown", "unit", "before", "learned", "bounds", "note", "key path"),
            [_row(subject, names[path], path, unknown) for path, unknown in result.unknowns.items()],
            rest="in result.json",
        )  # fmt: skip
    if result.unknowns and result.substeps is not None:
        yield Text(
            f"The values were found with {result.substeps} substeps in a control step. Keep that number wherever they "
            "are used."
        )


def _row(subject: Subject, title: str, path: str, unknown: Designed) -> tuple[str, ...]:
    spec = subject.run.scene.unknowns.get(path)
    before, learned_ = unknown.initial, unknown.value
    largest = max(map(abs, learned_ if isinstance(learned_, list) else [learned_]), default=0.0)
    name, factor = shown_unit(subject.unit(path) or "1", largest)
    texts = [
        spread([factor * v for v in (value if isinstance(value, list) else [value])]) for value in (before, learned_)
    ]
    bounds = "" if spec is None else " to ".join(short(factor * end) for end in spec.bounds)
    count = len(learned_) if isinstance(learned_, list) else 1
    ends = {"lower": unknown.at_bounds.lower, "upper": unknown.at_bounds.upper}
    at = [
        f"{n:,} of {count:,} at the {end} bound" if count > 1 else f"at its {end} bound" for end, n in ends.items() if n
    ]
    return title, name or "-", *texts, bounds, ", ".join(at), path

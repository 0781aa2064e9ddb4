"""What an identification found: unknowns with intervals, and what the intervals hold fixed."""

from __future__ import annotations

from collections.abc import Iterator

from cqrun.figures.quantities import estimate, labels, number, shown_unit
from cqrun.jobs.studies.quantities import bound_reached
from cqrun.report.blocks import Block, Number, Numbers, Table, Text
from cqrun.report.subject import Subject
from cqrun.report.words import joined, short, spread, with_unit
from cqrun.store.result import Identified, Interval, SysidResult
from cqrun.units import Unit

MANY = 8
"""If an unknown has more numbers, only their range is shown."""

MOST_IN_FRONT = 6
"""Numbers in large type, at most."""


def identified(subject: Subject, result: SysidResult) -> Iterator[Block]:
    """Yield the unknowns with their intervals, and the errors of the model."""
    scene = subject.run.scene
    names = dict(zip(result.unknowns, labels(list(result.unknowns), scene.dim), strict=True))
    front = [each for path, unknown in result.unknowns.items() for each in _front(subject, names[path], path, unknown)]
    yield Numbers([*front[:MOST_IN_FRONT], *_errors(subject, result)])
    if result.unknowns:
        head = ("unknown", "value", "95 % interval", "unit", "start", "bounds", "note", "key path")
        rows = [row for path, unknown in result.unknowns.items() for row in _rows(subject, names[path], path, unknown)]
        yield Table(head, rows, rest="in result.json")
    if result.unknowns and result.substeps is not None:
        yield Text(
            f"The values were found with {result.substeps} substeps in a control step. Keep that number wherever they "
            "are used."
        )
    yield from _held(result)


def _display(subject: Subject, path: str, values: list[float]) -> Unit:
    return shown_unit(subject.unit(path) or "1", max(map(abs, values)))


def _front(subject: Subject, name: str, path: str, unknown: Identified) -> Iterator[Number]:
    """Yield an unknown's numbers in large type."""
    values, intervals, _ = unknown.numbers()
    unit = _display(subject, path, values)
    if len(values) > MANY:
        yield Number(name, spread([unit.factor * value for value in values]), f"{unit.name} in {len(values)} values")
        return
    for k, (value, pair) in enumerate(zip(values, intervals, strict=True)):
        ends = None if pair is None else (unit.factor * pair[0], unit.factor * pair[1])
        best, _, interval = estimate(unit.factor * value, ends).partition(" (")
        detail = "no interval" if pair is None else f"95 % interval {joined(interval.rstrip(')'), unit.name)}"
        yield Number(f"{name} {k}" if len(values) > 1 else name, joined(best, unit.name), detail)


def _errors(subject: Subject, result: SysidResult) -> Iterator[Number]:
    """Yield the error of the model for the first recordings, or the loss."""
    scene = subject.run.scene
    if result.recordings is None or scene.data is None:
        if result.loss is not None:
            yield Number("Loss", with_unit(result.loss, scene.loss_unit, shown=False))
        return
    for name, error in list(result.recordings.items())[:2]:
        measured = subject.measurement(name)
        rmse = None if measured is None else error.number(measured.error_key("rmse"))
        if measured is not None and rmse is not None:
            yield Number("Error of the model (RMSE)", joined(short(rmse), measured.shown.name), f"recording {name}")


def _rows(subject: Subject, title: str, path: str, unknown: Identified) -> Iterator[tuple[str, ...]]:
    """Yield a row for each number of an unknown, or one row for many."""
    values, intervals, starts = unknown.numbers()
    unit, spec = _display(subject, path, values), subject.run.scene.unknowns.get(path)
    bounds = "" if spec is None else " to ".join(short(unit.factor * end) for end in spec.bounds)
    name_of_unit = unit.name or "-"
    if len(values) > MANY:
        shown = [unit.factor * value for value in values]
        at = 0 if spec is None else sum(bound_reached(spec, value) is not None for value in values)
        note = f"{at} of {len(values)} at a bound" if at else ""
        first = short(unit.factor * starts[0])
        yield title, spread(shown), f"{len(values)} values", name_of_unit, first, bounds, note, path
        return
    for k, (value, pair, start) in enumerate(zip(values, intervals, starts, strict=True)):
        width = None if pair is None else min(abs(pair[1] - value), abs(value - pair[0])) * unit.factor
        end = None if spec is None else bound_reached(spec, value)
        note = "" if end is None else f"at its bound {short(unit.factor * end)}"
        if pair is None and unknown.reason:
            note = f"{note}; {unknown.reason}" if note else unknown.reason
        yield (
            f"{title} {k}" if len(values) > 1 else title, number(unit.factor * value, width),
            _interval(pair, unit, width), name_of_unit, short(unit.factor * start), bounds, note,
            unknown.names(path)[k],
        )  # fmt: skip


def _interval(pair: Interval | None, unit: Unit, width: float | None) -> str:
    return "none" if pair is None else " to ".join(number(unit.factor * end, width) for end in pair)


def _held(result: SysidResult) -> Iterator[Block]:
    """Yield what the intervals hold fixed, and what the fit would find with another value."""
    rows = [
        (path, short(held.value), short(held.other), name, short(value))
        for path, held in result.held.items()
        for name, value in held.found.items()
    ]
    if rows:
        yield Text("The intervals are right only if these numbers are. With another value, the fit would find about:")
        yield Table(("held fixed", "is", "if it were", "unknown", "would be"), rows, rest="in result.json")

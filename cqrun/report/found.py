"""Section: what a run found, by the kind of its result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from cqrun.learning.description import constraint_cells
from cqrun.report.asked import point
from cqrun.report.blocks import Block, Number, Numbers, Table, Text
from cqrun.report.identified import identified
from cqrun.report.learned import learned
from cqrun.report.subject import Subject
from cqrun.report.tables import cell, table_of
from cqrun.report.words import count, short, unit_text, with_unit
from cqrun.scene.keypath import shortest
from cqrun.store.result import GradcheckResult, LearnedResult, RestResult, SimulateResult, SysidResult
from cqrun.units import force_units

MOST_COLUMNS = 12
"""Displacements and reactions of a path of equilibria that are shown, at most."""


def found(subject: Subject) -> Iterator[Block]:
    """Yield the numbers that a run found; of an unfinished run, how far it is."""
    result = subject.run.result
    if result is None:
        yield from _so_far(subject)
    else:
        yield from BY_RESULT[type(result)](subject, result)


def _so_far(subject: Subject) -> Iterator[Block]:
    """Yield how far a run without a result is."""
    history = subject.run.history
    if not history or "loss" not in history:
        yield Text("The run has no result yet.")
        return
    loss, unit = history["loss"], subject.run.scene.loss_unit
    yield Text(f"The run has no result yet. So far it has done {count(int(history['iteration'][-1]), 'iteration')}.")
    yield Numbers([
        Number("Loss at the start", with_unit(float(loss[0]), unit, shown=False)),
        Number("Loss now", with_unit(float(loss[-1]), unit, shown=False)),
    ])  # fmt: skip


def _simulated(subject: Subject, result: SimulateResult) -> Iterator[Block]:
    """Yield extremes of the bodies, forces of the boundaries, and the terms of the objective."""
    fastest = max((m.fastest for m in result.bodies.values()), default=0.0)
    numbers = [Number("Simulated time", f"{short(result.time)} s"), Number("Top speed", f"{short(fastest)} m/s")]
    least = min((m.least_volume_ratio for m in result.bodies.values()), default=1.0)
    numbers.append(Number("Least volume ratio", short(least), "volume divided by that at rest"))
    if result.loss is not None:
        numbers.append(Number("Loss", short(result.loss)))
    yield Numbers(numbers)
    head = ("body", "centroid at the end [m]", "top speed [m/s]", "least volume ratio", "kinetic energy at the end")
    yield Table(head, [
        (name, point(m.centroid), short(m.fastest), short(m.least_volume_ratio), short(m.kinetic_energy))
        for name, m in result.bodies.items()
    ])  # fmt: skip
    if result.boundaries:
        unit = unit_text(force_units(subject.run.scene.dim)[0])
        rows = [(name, point(force.mean), short(force.largest)) for name, force in result.boundaries.items()]
        yield Table(("boundary", f"mean force on the bodies [{unit}]", f"largest force [{unit}]"), rows)
    if result.terms is not None:
        yield Table(("term of the objective", "value"), [(name, short(v)) for name, v in result.terms.items()])
    if result.constraints:
        cells = [(name, *constraint_cells(value)) for name, value in result.constraints.items()]
        yield Table(("constraint", "wanted", "value", "violated by"), cells)


def _rested(subject: Subject, result: RestResult) -> Iterator[Block]:
    """Yield the points of a path of equilibria, with displacements and reactions."""
    ended = sum(p.converged for p in result.points)
    worst = max((p.residual for p in result.points if p.converged), default=None)
    numbers = [Number("Equilibria found", f"{ended} of {len(result.points)}")]
    if worst is not None:
        numbers.append(Number("Largest residual", f"{worst:.1e}", "net force divided by the loads"))
    yield Numbers(numbers)
    keys, seen = list(result.points[0].values) if result.points else [], _measured_at_rest(subject)
    head = ("point", *(shortest(keys) if keys else []), *seen, "found", "residual")
    yield Table(head, [
        (str(k), *(short(p.values[key]) if key in p.values else "-" for key in keys),
         *(column[k - 1] if k <= len(column) else "-" for column in seen.values()),
         "yes" if p.converged else "no", f"{p.residual:.1e}")
        for k, p in enumerate(result.points, start=1)
    ], rest="in rest.csv")  # fmt: skip


def _measured_at_rest(subject: Subject) -> dict[str, list[str]]:
    """Return displacements of groups and reactions of boundaries along a path, as columns with units.

    Raises:
        UsageError: rest.csv is damaged.
    """
    path = subject.run.path / "rest.csv"
    if not path.is_file():
        return {}
    rows = table_of(path)
    force, moment = force_units(subject.run.scene.dim)
    groups = {f"{name}.{group}" for name, body in subject.run.scene.bodies.items() for group in body.groups}
    found: dict[str, list[str]] = {}
    for k, name in enumerate(rows[0]):
        what, _, last = name.rpartition(".")
        unit = "m" if what in groups and last[:1] == "d" else force if last[:6] == "force_" else ""
        unit = moment if last[:6] == "moment" and what in subject.run.scene.boundaries else unit
        if unit and len(found) < MOST_COLUMNS:
            found[f"{name} [{unit_text(unit)}]"] = [cell(row[k]) for row in rows[1:]]
    return found


def _checked(subject: Subject, result: GradcheckResult) -> Iterator[Block]:
    """Yield the adjoint and the differences along each direction."""
    errors = [row.error for row in result.rows if row.error is not None]
    numbers = [Number("Directions that agree", f"{sum(row.agrees for row in result.rows)} of {len(result.rows)}")]
    if errors:
        numbers.append(Number("Largest relative error", f"{max(errors):.1e}"))
    yield Numbers([*numbers, Number(result.of[:1].upper() + result.of[1:], f"{result.loss:.6g}")])
    head = ("direction", "numbers", "adjoint", "differences", "relative error", "step", "verdict")
    yield Table(head, [
        (row.block, f"{row.count:,}", f"{row.adjoint:.7e}", *("-" if n is None else format(n, form)
         for n, form in ((row.differences, ".7e"), (row.error, ".1e"))), f"{row.step:.1e}", row.verdict)
        for row in result.rows
    ], rest="in gradcheck.json")  # fmt: skip


BY_RESULT: dict[type, Callable[[Subject, Any], Iterator[Block]]] = {
    SysidResult: identified,
    LearnedResult: learned,
    SimulateResult: _simulated,
    RestResult: _rested,
    GradcheckResult: _checked,
}
"""What is reported of each kind of result."""

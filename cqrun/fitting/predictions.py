"""Predict recordings with given values of the unknowns, and write what the model predicts.

tracks.csv      recorded and modelled markers, for the plots; other measurements have their own table
trajectory.h5   the first fitted case, or the first case that can be predicted, with the values among its attributes;
                at rest, frame 0 is the rest shape, and one frame per point follows
measurements.csv  the quantities that the scene measures, in the same case
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from cqrun.build.thickness import thinnest_parts
from cqrun.design.params import Params
from cqrun.engine.model import Records
from cqrun.errors import NoRestError, RolloutError
from cqrun.fitting.case import Case
from cqrun.observers.fracture import Fracture
from cqrun.plugin.contract import Array
from cqrun.running.measuring import Measuring, write_measured
from cqrun.running.observables import fracture_of
from cqrun.running.trajectories import as_found
from cqrun.state import State
from cqrun.store.atomic import write_table
from cqrun.store.result import Identified, RecordingError, SysidResult, Value, write_result
from cqrun.store.run import RunDirectory

Interrupt = Callable[[], None]

NOTHING_FITTED = "nothing was fitted, because every recording is held out"


def write_predictions(
    run: RunDirectory, cases: Sequence[Case], values: Mapping[str, Array], result: SysidResult, threads: int,
    interrupt: Interrupt,
) -> list[Records | None]:  # fmt: skip
    """Predict every case, write tables and trajectory, and put errors, fractures and findings into the result.

    Args:
        values: of the unknowns, by path.
        interrupt: called before every rollout.

    Returns:
        The records of every case, None for a held-out one that blows up.
    """
    records = _predict(cases, values, result, threads, interrupt)
    result.recordings = _errors(cases, records, values)
    result.findings += _elsewhere(cases, records, values)
    _write_tables(run, cases, records, values)
    known = [case for case, record in zip(cases, records, strict=True) if record is not None]
    first = next((case for case in known if not case.holdout), next(iter(known), None))
    if first is not None:
        interrupt()
        provenance = as_found(values) | first.comparisons[0].wanted()
        own, measuring = first.own_values(values), Measuring(first.built, first.own_values(values))
        result.findings += first.runner.write(run.path / "trajectory.h5", own, threads, provenance, measuring)
        write_measured(run.path, measuring, result)
    return records


def write_prediction_alone(
    run: RunDirectory, cases: Sequence[Case], params: Params, threads: int, interrupt: Interrupt
) -> SysidResult:
    """Write the result of a run that fits nothing: predictions with the values that the unknowns start from."""
    values = params.start_values
    result = SysidResult(
        status="done", message=NOTHING_FITTED, loss=None, iterations=0, substeps=substeps_of(cases),
        unknowns=identified(params, values), thinnest=thinnest_parts(cases[0].built) if cases else {},
    )  # fmt: skip
    for unknown in result.unknowns.values():
        unknown.reason = NOTHING_FITTED
    records = write_predictions(run, cases, values, result, threads, interrupt)
    if not any(record is not None for record in records):
        result.status, result.message = "failed", f"no recording can be predicted: {result.findings[0]}"
    for sentence in result.findings:
        run.log(sentence)
    write_result(run.path, result)
    return result


def substeps_of(cases: Sequence[Case]) -> int | None:
    """Return the number of substeps of all motions; None if all cases are at rest."""
    return next((case.built.model.substeps for case in cases if not case.points), None)


def identified(params: Params, values: Mapping[str, Array]) -> dict[str, Identified]:
    """Return the entries of a result for the unknowns, by path, without intervals."""
    return {b.path: Identified(initial=_plain(b.initial), value=_plain(values[b.path])) for b in params.blocks}


def _plain(value: Array) -> Value:
    return float(value) if np.ndim(value) == 0 else np.asarray(value).tolist()


def _predict(
    cases: Sequence[Case], values: Mapping[str, Array], result: SysidResult, threads: int, interrupt: Interrupt
) -> list[Records | None]:
    """Return every case's records with some values, None if a held-out one blows up; report fractures."""
    records: list[Records | None] = []
    whose = "the scene's" if all(case.holdout for case in cases) else "the identified"
    most: dict[str, int] = {}
    for case in cases:
        fracture = fracture_of(case.built)

        def watch(control: int, state: State, fracture: Fracture = fracture) -> None:
            fracture.count(state.x)

        interrupt()
        try:
            records.append(case.run(values, threads, watch))
        except (RolloutError, NoRestError) as error:
            if not case.holdout:
                raise
            records.append(None)
            fails = "has no place of rest" if isinstance(error, NoRestError) else "blows up"
            result.findings.append(f"{case.name}: held out, and it {fails} with {whose} values: {error}")
        most |= {name: max(most.get(name, 0), number) for name, number in fracture.most.items()}
        result.findings += [f"{case.name}: {sentence}" for sentence in fracture.findings()]
    result.fracture = most
    return records


def _errors(
    cases: Sequence[Case], records: list[Records | None], values: Mapping[str, Array]
) -> dict[str, RecordingError] | None:
    """Return the RMSE, in total and by channel, and facts about each recording by its name; None without data."""
    errors: dict[str, RecordingError] = {}
    for case, record in zip(cases, records, strict=True):
        data = case.built.scene.data
        if data is None:
            return None
        measured = data.measurement(case.name)
        rmse, factor = measured.error_key("rmse"), measured.shown.factor
        entry: dict[str, Any] = {rmse: None}
        for comparison in case.comparisons:
            entry |= comparison.facts()
        if record is not None:
            compared, start = case.compared(values), case.start_of(values)
            misfits = [o.misfit(record, start) for o in compared]
            entry[rmse] = factor * float(np.sqrt(np.mean([m.total**2 for m in misfits])))
            if len(misfits) == 1:
                entry[measured.error_key(f"{measured.channel}s")] = {
                    name: None if np.isnan(e) else factor * e for name, e in misfits[0].channels.items()
                }
                entry |= compared[0].details(record, start)
        errors[case.name] = RecordingError(holdout=case.holdout, **entry)
    return errors


def _elsewhere(cases: Sequence[Case], records: Sequence[Records | None], values: Mapping[str, Array]) -> Iterator[str]:
    """Yield what is notable about single points of recordings at rest, and about signs of forces."""
    for case, record in zip(cases, records, strict=True):
        for comparison in case.compared(values) if record is not None else ():
            if record is not None:
                found = comparison.findings(record, case.start_of(values))
                yield from (f"{case.name}: {sentence}" for sentence in found)


def _write_tables(
    run: RunDirectory, cases: Sequence[Case], records: list[Records | None], values: Mapping[str, Array]
) -> None:
    """Write recording, channel, time in the run, data and model in SI units, for the first copy of every case."""
    tables: dict[str, list[list[object]]] = {}
    for case, record in zip(cases, records, strict=True):
        data = case.built.scene.data
        if record is None or data is None:
            continue
        head, *rows = case.compared(values)[0].table(record, case.start_of(values))
        table = tables.setdefault(data.measurement(case.name).table_name, [["recording", *head]])
        table += [[case.name, *row] for row in rows]
    for name, table in tables.items():
        write_table(run.path / name, table)

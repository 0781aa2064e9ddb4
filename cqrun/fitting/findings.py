"""Write the results of an identification: result.json has values, intervals, errors and findings.

`predictions.py` writes the other files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cqrun.build.thickness import thinnest_parts
from cqrun.design.params import Block, Spread
from cqrun.engine.model import Records
from cqrun.fitting import assumptions
from cqrun.fitting.case import Case
from cqrun.fitting.identifiability import Unknown
from cqrun.fitting.predictions import identified, substeps_of, write_predictions
from cqrun.fitting.problem import FitProblem
from cqrun.fitting.stiffness import fitted_moduli
from cqrun.fitting.uncertainty import MOST_UNKNOWNS, central_jacobian, intervals
from cqrun.optimizers.base import Outcome, TrialFailed
from cqrun.plugin.contract import Array
from cqrun.store.result import Interval, SysidResult, write_result
from cqrun.store.run import RunDirectory
from cqrun.units import format_bytes


def write_findings(run: RunDirectory, cases: list[Case], problem: FitProblem, outcome: Outcome) -> SysidResult:
    """Write result.json and, if the run has finished and did not fail, tables and trajectory; return the result."""
    params = problem.params
    values = params.unpack(outcome.x)
    result = SysidResult(
        status=outcome.status,
        message=outcome.message,
        loss=problem.unit * outcome.loss if np.isfinite(outcome.loss) else None,
        iterations=outcome.iterations,
        substeps=substeps_of(cases),
        unknowns=identified(params, values),
        thinnest=thinnest_parts(problem.cases[0].built),
    )
    if outcome.status == "stopped":
        _no_intervals(result, "the run was stopped; the values are those of its last iteration")
    elif outcome.status != "failed":
        _add_intervals(result, problem, outcome)
        records = write_predictions(run, cases, values, result, problem.threads, problem.interrupt)
        result.findings[:0] = [
            f"{case.name}: {sentence}"
            for case, record in zip(cases, records, strict=True)
            for comparison in (case.comparisons if record is not None else ())
            for sentence in getattr(comparison, "wrong_at_the_end", lambda _: [])(record)
        ]
        result.loss = _loss(problem, dict(zip([c.name for c in cases], records, strict=True)), values)
    if outcome.status in ("iteration_limit", "stalled"):
        result.findings.append(f"{outcome.status.replace('_', ' ')}: values and intervals are those of the last point")
    for sentence in result.findings:
        run.log(sentence)
    _record_effort(run, problem)
    write_result(run.path, result)
    return result


def _loss(problem: FitProblem, records: Mapping[str, Records | None], values: Mapping[str, Array]) -> float:
    """Return the loss of all fitted data with the identified values; an optimizer may have used mini-batches."""
    total = 0.0
    for case, weights in zip(problem.cases, problem.weights, strict=True):
        record = records[case.name]
        assert record is not None
        total += float(np.dot(weights, case.losses(record, values)))
    return total


def _record_effort(run: RunDirectory, problem: FitProblem) -> None:
    """Write the cost of gradients into run.json: unlike the result, it depends on the number of threads."""
    effort = problem.effort
    if effort.recompute:  # 0 if a resumed run has computed no gradient
        run.log(
            f"gradients: {effort.recompute:.3g} forward substeps for each substep of the rollout, "
            f"at most {format_bytes(effort.peak)} of kept states{effort.way}"
        )
        run.add_facts(gradient={"recompute_factor": effort.recompute, "peak_bytes": effort.peak})


# --- intervals ----------------------------------------------------------------------------------------------


def _add_intervals(result: SysidResult, problem: FitProblem, outcome: Outcome) -> None:
    unknowns, held = list_unknowns(problem, outcome.x), assumptions.held_numbers(problem)
    result.findings += assumptions.at_bounds(problem, outcome.x, held)
    result.moduli = fitted_moduli(problem.cases[0].built.scene, unknowns, None)
    if problem.cases[0].built.scene.data is None:
        _no_intervals(result, "a fit to an objective has no noise to compute an interval from")
        return
    try:
        jacobian = _find_jacobian(problem, outcome.x, unknowns)
    except NoIntervals as reason:
        _no_intervals(result, str(reason))
        result.findings += assumptions.without_intervals(held)
        return
    residuals = problem.residuals(outcome.x)
    uncertainty = intervals(jacobian, residuals, problem.series(), unknowns)
    result.moduli = fitted_moduli(problem.cases[0].built.scene, unknowns, uncertainty)
    for block in problem.params.blocks:
        names = _names(block)
        entry = result.unknowns[block.path]
        if isinstance(block, Spread):
            entry.reason = "its values follow from fewer numbers, those of a field or of mirrored pairs"
            continue
        pairs = [_pair(uncertainty.intervals[n]) for n in names]
        entry.interval = pairs if block.initial.ndim else pairs[0]
        reasons = {n: uncertainty.reasons[n] for n in names if n in uncertainty.reasons}
        if reasons:
            entry.reason = "; ".join(dict.fromkeys(reasons.values()))
    at_optimum = problem, outcome.x, jacobian, unknowns, uncertainty
    result.findings += uncertainty.findings
    result.findings += assumptions.of_slow_errors(problem, residuals)
    result.findings += assumptions.of_the_substep(*at_optimum)
    result.held = assumptions.effects_of_held(*at_optimum, held)
    result.findings += assumptions.of_held_numbers(result.held, unknowns, uncertainty)
    result.findings += assumptions.of_plane_strain(problem, unknowns)


def _no_intervals(result: SysidResult, reason: str) -> None:
    for entry in result.unknowns.values():
        entry.reason = reason


def _pair(interval: Interval | None) -> Interval | None:
    return None if interval is None else (float(interval[0]), float(interval[1]))


def _names(block: Block) -> list[str]:
    return [f"{block.path}[{k}]" for k in range(block.size)] if block.initial.ndim else [block.path]


def list_unknowns(problem: FitProblem, x: Array) -> list[Unknown]:
    """Return every fitted number at x in the form that the statistics use."""
    params = problem.params
    return [
        Unknown(name, float(value), block.lower, block.upper, block.log)
        for block, part in zip(params.blocks, params.slices.values(), strict=True)
        for name, value in zip(_names(block), block.numbers(x[part]), strict=True)
    ]


class NoIntervals(Exception):
    """Why intervals cannot be computed."""


def _find_jacobian(problem: FitProblem, x: Array, unknowns: Sequence[Unknown]) -> Array:
    """Return dr/dz (n, p) at the optimum, by central differences; raise NoIntervals if that is not possible."""
    if len(unknowns) > MOST_UNKNOWNS:
        raise NoIntervals(f"more than {MOST_UNKNOWNS} unknowns")
    if problem.cases[0].built.scene.precision == "float32":
        raise NoIntervals("`precision: float32` is too coarse for the finite differences of intervals")
    try:
        return find_jacobian(problem, x, unknowns)
    except TrialFailed as failure:
        raise NoIntervals(f"a rollout near the optimum failed: {failure}") from failure


def find_jacobian(problem: FitProblem, x: Array, unknowns: Sequence[Unknown]) -> Array:
    """Return dr/dz (n, p) at the optimum by central differences."""
    parts = list(zip(problem.params.blocks, problem.params.slices.values(), strict=True))

    def residuals_at(points: list[Array]) -> list[Array]:
        scaled = [np.concatenate([b.to_scaled(point[part]).reshape(-1) for b, part in parts]) for point in points]
        return problem.residuals_at(scaled) if scaled else []

    return central_jacobian(residuals_at, unknowns)

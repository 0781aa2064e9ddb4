"""What a run found, as lines for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cqrun.jobs.gradcheck import lines_of
from cqrun.learning.learned import STAGES, blown_up
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf
from cqrun.scene.schema import Scene
from cqrun.store.result import (
    ConstraintValue,
    Designed,
    GradcheckResult,
    Identified,
    Interval,
    LearnedResult,
    SimulateResult,
    SysidResult,
    Value,
    read_result,
)
from cqrun.store.run import read_record

MANY = 8
"""A block of more numbers is told by its range."""


def report_lines(run_dir: Path) -> list[str]:
    """Return what a finished run found; for one that goes on, its status.

    Raises:
        UsageError: it is no run, or what it found cannot be read.
    """
    record, result = read_record(run_dir), read_result(run_dir)
    if result is None:
        return [_status(record)]
    if isinstance(result, GradcheckResult):
        return lines_of(result)
    if isinstance(result, SysidResult):
        lines = _sysid(run_dir, result)
    else:
        lines = _simulate(result) if isinstance(result, SimulateResult) else _control(result)
    return [*lines, *_pictures(run_dir)]


def _status(record: dict[str, Any]) -> str:
    return f"{record['job']}: {record['status']}" + (f" ({record['reason']})" if record.get("reason") else "")


# --- sysid --------------------------------------------------------------------------------------------------


def _sysid(run_dir: Path, result: SysidResult) -> Iterator[str]:
    scene = load_scene(run_dir / "scene.yaml", (), Path(str(read_record(run_dir).get("base", ""))))
    yield f"{result.status} after {result.iterations} iterations: {result.message}"
    yield ""
    yield from table(
        ("unknown", "value", "95 % interval", "unit", "from"),
        [row for path, found in result.unknowns.items() for row in _unknown(scene, path, found)],
    )
    reasons = {path: found.reason for path, found in result.unknowns.items() if found.reason}
    if reasons:
        yield ""
        if len(reasons) == len(result.unknowns) and len(set(reasons.values())) == 1:
            yield f"no intervals: {next(iter(reasons.values()))}"
        else:
            yield from (f"no interval for {path}: {reason}" for path, reason in reasons.items())
    yield ""
    yield from _errors(result)
    yield from (f"note: {sentence}" for sentence in result.findings)


def _unknown(scene: Scene, path: str, found: Identified) -> Iterator[tuple[str, ...]]:
    unit = leaf(scene, path).unit
    values, intervals, initials = found.numbers()
    if len(values) > MANY:
        ends = f"{number(min(values))} ... {number(max(values))}"
        yield path, ends, f"{len(values)} numbers", unit, number(initials[0])
        return
    for k, (value, interval, initial) in enumerate(zip(values, intervals, initials, strict=True)):
        name = f"{path}[{k}]" if isinstance(found.value, list) else path
        yield name, number(value), _interval(interval), unit, number(initial)


def _interval(pair: Interval | None) -> str:
    return "none" if pair is None else f"{number(pair[0])} to {number(pair[1])}"


def _errors(result: SysidResult) -> Iterator[str]:
    if result.recordings is None:
        if result.loss is not None:
            yield f"loss {result.loss:.6g} m^2"
        return
    rows = []
    for name, found in result.recordings.items():
        rmse = "blew up" if found.rmse_mm is None else f"{found.rmse_mm:.3f}"
        markers = found.markers_mm or {}
        by_marker = ", ".join(f"{m} {'unseen' if e is None else f'{e:.3f}'}" for m, e in markers.items())
        rows.append((name, "held out" if found.holdout else "fitted", rmse, by_marker if len(markers) <= 12 else ""))
    yield from table(("recording", "", "RMSE [mm]", "by marker [mm]"), rows)
    for name, found in result.recordings.items():
        if away := (found.alignment_mm or {}).values():
            yield f"{name}: aligned to the rest positions within {min(away):.2f} to {max(away):.2f} mm"


# --- control ------------------------------------------------------------------------------------------------


def _control(result: LearnedResult) -> Iterator[str]:
    yield f"{result.status} after {result.iterations} iterations: {result.message}"
    stages = result.stages()
    if not stages:
        return
    yield ""
    terms = next(iter(stages.values())).terms
    rows = [(term, *(number(stage.terms[term]) for stage in stages.values())) for term in terms]
    rows.append(("loss", *(number(stage.loss) for stage in stages.values())))
    yield from table(("term", *(STAGES[name] for name in stages)), rows)
    yield from blown_up(result)
    if result.constraints:
        yield ""
        held = [(name, *_held(found)) for name, found in result.constraints.items()]
        yield from table(("constraint", "wanted", "before", "learned", "violated by"), held)
    if result.unknowns:
        yield ""
        design = [(path, _range(u.initial), _range(u.value), _ends(u)) for path, u in result.unknowns.items()]
        yield from table(("unknown", "before", "learned", "at its bounds"), design)


def _held(found: ConstraintValue) -> tuple[str, ...]:
    """Return what a constraint asks for, and its numbers: before where there is one, now, and the violation."""
    ends = {"at least": found.at_least, "at most": found.at_most, "": found.equals}
    wanted = ", ".join(f"{word} {number(end)}".strip() for word, end in ends.items() if end is not None)
    return wanted, *(number(n) for n in (found.start, found.value, found.violation) if n is not None)


def _ends(found: Designed) -> str:
    """Return how many of an unknown's numbers are at its bounds."""
    ends = {"lower": found.at_bounds.lower, "upper": found.at_bounds.upper}
    count = len(found.value) if isinstance(found.value, list) else 1
    told = ", ".join(f"{n:,} {end}" if count > 1 else end for end, n in ends.items() if n)
    return f"{told} of {count:,}" if told and count > 1 else told


def _range(value: Value) -> str:
    """Return one number, or the least, mean and greatest of many."""
    if not isinstance(value, list):
        return number(value)
    low, high, mean = min(value), max(value), sum(value) / len(value)
    return number(low) if low == high else f"{number(low)} to {number(high)}, mean {number(mean)}"


# --- simulate -----------------------------------------------------------------------------------------------


def _simulate(result: SimulateResult) -> Iterator[str]:
    yield f"{result.status}: {result.message}"
    yield ""
    rows = [
        (
            body,
            ", ".join(number(c) for c in motion.centroid),
            number(motion.fastest),
            number(motion.least_volume_ratio),
            number(motion.kinetic_energy),
        )
        for body, motion in result.bodies.items()
    ]
    yield from table(("body", "centroid at the end [m]", "fastest [m/s]", "least volume ratio", "kinetic energy"), rows)
    if result.terms is not None and result.loss is not None:
        values = {**result.terms, "loss": result.loss}
        yield ""
        yield from table(("term", "value"), [(name, number(value)) for name, value in values.items()])
    if result.constraints:
        held = [(name, *_held(found)) for name, found in result.constraints.items()]
        yield ""
        yield from table(("constraint", "wanted", "value", "violated by"), held)
    yield from (f"note: {sentence}" for sentence in result.findings)


# --- everywhere ---------------------------------------------------------------------------------------------


def _pictures(run_dir: Path) -> Iterator[str]:
    files = sorted((run_dir / "figures").glob("*.png"))
    files += [file for name in ("tracks.csv", "observables.csv", "trajectory.h5") if (file := run_dir / name).exists()]
    if files:
        yield ""
        yield "see " + ", ".join(str(file.relative_to(run_dir)) for file in files)


def number(value: float) -> str:
    """Return a number with five digits."""
    return f"{value:.5g}"


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """Yield the lines of a table whose columns are as wide as they need to be."""
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    for row in (head, *rows):
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()

"""Read what the run on one grid found: numbers that can be compared between grids."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.build.model import Built
from cqrun.disk import open_file
from cqrun.errors import UsageError
from cqrun.fitting.uncertainty import AT_BOUND
from cqrun.jobs.studies.oscillation import frequency
from cqrun.plugin.contract import Array
from cqrun.running.rest_table import AXES
from cqrun.scene.data import Unknown
from cqrun.scene.paths import leaf
from cqrun.store.atomic import disk_errors
from cqrun.store.frames import Frames
from cqrun.store.result import Interval, SysidResult, read_result, require_result
from cqrun.units import force_units

STILL = 1e-6
"""A motion smaller than this part of a cell does not oscillate."""


@dataclass(frozen=True)
class Quantity:
    """A number that a run found.

    Attributes:
        value: the number.
        unit: its unit; empty for a pure number.
        log: whether its logarithm is extrapolated.
        least: the least value that it can have.
        interval: its 95 % interval, if it has one.
        bound: the bound at which it ended, if it did.
    """

    value: float
    unit: str
    log: bool = False
    least: float = -np.inf
    interval: Interval | None = None
    bound: float | None = None


def quantities_of(job: str, run: Path, built: Built) -> dict[str, Quantity]:
    """Return what a finished run of sysid, rest or simulate found, by name; first what its scene measures."""
    kinds = {"sysid": _identified, "rest": _at_rest, "simulate": _in_motion}
    return measured_in(run) | dict(kinds[job](run, built))


def measured_in(run: Path) -> dict[str, Quantity]:
    """Return the quantities that the scene of a finished run measures: each number's last value and its extremes."""
    found: dict[str, Quantity] = {}
    for name, number in getattr(read_result(run), "measured", {}).items():
        unit = "" if number.unit == "1" else number.unit
        found |= {f"{name}.{end}": Quantity(getattr(number, end), unit) for end in ("end", "least", "largest")}
    return found


# --- sysid ------------------------------------------------------------------------------------------------------------


def _identified(run: Path, built: Built) -> Iterator[tuple[str, Quantity]]:
    """Yield the unknowns, but not those with a number for each particle, and the errors of the recordings."""
    scene, result = built.scene, require_result(run, SysidResult)
    for path, unknown in result.unknowns.items():
        spec = scene.unknowns[path]
        if spec.per not in ("body", "group") or scene.predicts_only:
            continue
        unit, (values, intervals, _) = leaf(scene, path).unit, unknown.numbers()
        unit = "" if unit == "1" else unit
        for name, value, interval in zip(unknown.names(path), values, intervals, strict=True):
            yield (
                name,
                Quantity(value, unit, log=spec.scale == "log", interval=interval, bound=bound_reached(spec, value)),
            )
    for name, error in (result.recordings or {}).items():
        assert scene.data is not None
        measured = scene.data.measurement(name)
        rmse = error.number(measured.error_key("rmse"))
        if rmse is not None:
            yield f"{name}: RMSE", Quantity(rmse, measured.shown.name, least=0.0)
    if result.recordings is None and result.loss is not None:
        yield "loss", Quantity(result.loss, scene.loss_unit)


def bound_reached(spec: Unknown, value: float) -> float | None:
    """Return the bound at which the value of an unknown lies; None if it lies inside."""
    scaled = [float(np.log(v)) if spec.scale == "log" else v for v in (value, *spec.bounds)]
    for end, bound in zip(scaled[1:], spec.bounds, strict=True):
        if abs(scaled[0] - end) <= AT_BOUND * (scaled[2] - scaled[1]):
            return float(bound)
    return None


# --- rest -------------------------------------------------------------------------------------------------------------


def _at_rest(run: Path, built: Built) -> Iterator[tuple[str, Quantity]]:
    """Yield displacements of bodies and groups at the last point, and the reactions of the boundaries."""
    row = _last_row(run / "rest.csv")
    force, moment = force_units(built.scene.dim)
    for body in built.particles.names:
        for axis, start in zip(AXES, _centre(built, body), strict=False):
            yield f"{body}.d{axis}", Quantity(row[f"{body}.{axis}"] - float(start), "m")
        for group in built.scene.bodies[body].groups:
            for axis in AXES[: built.scene.dim]:
                yield f"{body}.{group}.d{axis}", Quantity(row[f"{body}.{group}.d{axis}"], "m")
    for boundary in (*built.scene.boundaries, *built.scene.rigid):
        for key in (key for key in row if key.startswith((f"{boundary}.force_", f"{boundary}.moment"))):
            yield key, Quantity(row[key], moment if ".moment" in key else force)


def _last_row(path: Path) -> dict[str, float]:
    """Return the last row of a table, without empty cells; raise UsageError if it is damaged."""
    with disk_errors(path), open_file(path, "r", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        return {key: float(value) for key, value in rows[-1].items() if value}
    except (IndexError, ValueError, TypeError) as error:
        raise UsageError(f"{path}: is damaged; run it again with --fresh") from error


# --- simulate ---------------------------------------------------------------------------------------------------------


def _in_motion(run: Path, built: Built) -> Iterator[tuple[str, Quantity]]:
    """Yield deflections of bodies and groups, at the end and the largest one, and the frequency if they oscillate."""
    points = dict(_points(built))
    with Frames(run / "trajectory.h5") as frames:
        tracks: dict[str, list[Array]] = {name: [] for name in points}
        for k in range(len(frames)):
            x = frames.read("x", k)
            for name, (members, weights) in points.items():
                tracks[name].append(weights @ x[members])
        time = frames.time
    for name, track in tracks.items():
        moved = np.array(track) - track[0]
        size = np.linalg.norm(moved, axis=1)
        yield f"{name}.deflection", Quantity(float(size[-1]), "m", least=0.0)
        yield f"{name}.largest_deflection", Quantity(float(size.max()), "m", least=0.0)
        along = moved[:, int(np.argmax(moved.std(axis=0)))]
        if np.ptp(along) > STILL * built.scene.world.dx and (rate := frequency(time, along)) is not None:
            yield f"{name}.frequency", Quantity(rate, "Hz")


def _points(built: Built) -> Iterator[tuple[str, tuple[Array, Array]]]:
    """Yield the particles and weights whose mean is the centre of each body, and the place of each group, by name."""
    mass = built.assembly.inputs({}).fields.mass
    for body in built.particles.names:
        part = built.particles.of(body)
        yield body, (np.arange(part.start, part.stop), mass[part] / mass[part].sum())
        for group, members in built.particles.groups(body).items():
            if len(members):
                yield f"{body}.{group}", (members, np.full(len(members), 1.0 / len(members)))


def _centre(built: Built, body: str) -> Array:
    """Return the centre of mass of a body at rest (D,) [m]."""
    mass, part = built.assembly.inputs({}).fields.mass, built.particles.of(body)
    return np.asarray(mass[part] @ built.particles.x[part] / mass[part].sum())

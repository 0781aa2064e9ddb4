"""Poses: where markers on a body rest under stated loads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from cqrun.engine.model import Records
from cqrun.errors import DataError
from cqrun.explain import Loc, listed
from cqrun.measurements.alignment import Measured
from cqrun.measurements.at_rest import LABEL, RestComparison, RestMeasurement
from cqrun.measurements.load_table import LoadTable, factor_of, read_table, split_unit
from cqrun.measurements.markers import MILLI, RestPosition, observe_markers, over_body, require_near
from cqrun.measurements.measurement import Recorded
from cqrun.measurements.points import Points
from cqrun.observers.matter import Matter
from cqrun.plugin import contract
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin
from cqrun.units import METRES, Unit

ELSEWHERE, FAR = 5.0, 0.5
"""A pose ends elsewhere if its error is so many times that of most poses, and such a part of the way of its markers."""

ADVICE = (
    "positions are in the axes of the scene: give `offset` if the file has another origin, `rotation` if it has other "
    "axes, `units`, or mend the rest positions"
)


@plugin("measurement", "poses")
class Poses(RestMeasurement):
    """Positions of markers on a body that has come to rest, under the loads of each pose.

    The file is CSV. In its long form each line is a marker in a pose, with the columns pose, marker, x, y(, z) and one
    for each load. In its wide form each line is a pose, with NAME_x, NAME_y(, NAME_z) for each marker. A length unit
    may stand at the end of a column's name (`x_mm`). An empty cell was not seen; a whole axis may be missing.

    Positions are in the axes of the scene, up to `offset` and `rotation`. A marker off the body stands on a rigid stem.
    The model is at rest in every pose, so speeds, viscosity and time have no part. The scene needs `world.frame:
    reference` and a boundary that holds the body. Each pose is found from the one before it or from the rest shape,
    whichever is nearer; the order of the poses matters only where a body has several places of rest.
    """

    quantity: ClassVar[str] = "position"
    unit: ClassVar[str] = "m"
    shown: ClassVar[Unit] = Unit("mm", MILLI)
    digits: ClassVar[str] = ".3f"
    channel: ClassVar[str] = "marker"
    takes: ClassVar[frozenset[str]] = frozenset({"units", "offset", "rotation"})

    markers: dict[str, RestPosition] = contract.quantity("m", "Marker -> position at rest in the scene", min_length=1)

    @property
    def rest(self) -> dict[str, Array]:
        """Rest position of each marker (D,) [m]."""
        return {name: np.array(position) for name, position in self.markers.items()}

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        message = f"must have {dim} entries in this {dim}D world, has "
        wrong = {name: len(x) for name, x in self.markers.items() if len(x) != dim}
        return super().dim_problems(dim) + [(("markers", name), f"{message}{n}") for name, n in wrong.items()]

    def bind(self, recorded: Recorded, matter: Matter) -> PoseComparison:
        table, names = read_table(recorded.file), list(self.markers)
        loads, is_long = self.line_loads(table), "marker" in table.head
        read = _read_long if is_long else _read_wide
        labels, lines, values, used = read(table, names, matter.dim, recorded.units)
        table.require_all_used({*used, *self.loads, *self.ignore, LABEL}, "is neither a load nor a marker's position")
        points = [loads[line] for line in lines]
        self.require_loads(table, len(points))
        _require_same_loads(self, table, labels)
        self._require_near(recorded, matter, table, values)
        observer = observe_markers(matter, recorded.body, self.rest)
        rows = over_body(observer.rows, recorded.body, matter)
        return PoseComparison(
            self, recorded, observer, rows, names, points, (LABEL, list(dict.fromkeys(labels))), values
        )

    def _require_near(self, recorded: Recorded, matter: Matter, table: LoadTable, values: Array) -> None:
        """Refuse positions that are never near where their markers are at rest."""
        rest = np.array(list(self.rest.values()))
        known = np.where(np.isnan(values), rest, values)
        number = np.arange(len(values), dtype=float)
        measured = Measured(number, tuple(self.markers), rest, known, known[:0], True, None, table.source)
        require_near(matter, recorded.body, measured, recorded.placement, ADVICE)


class PoseComparison(RestComparison):
    """Markers where they were seen at rest, beside the model's; arguments as `RestComparison`, and:

    Args:
        observer: of the markers, over the body's particles.
    """

    def __init__(self, spec: Poses, recorded: Recorded, observer: Points, *rest: Any) -> None:
        super().__init__(spec, recorded, *rest)
        self.observer = observer

    def observe(self, records: Records) -> Array:
        """Return positions of the markers (P + 1, M, D) [m]."""
        return self.observer.observe(records)[0]

    def observe_vjp(self, records: Records, y_bar: Array) -> Records:
        """Return the cotangent of the records from that of the positions."""
        bar = records.zeros_like()
        bar.add(self.observer.observe_vjp(records, y_bar, np.zeros_like(y_bar)))
        return bar

    def details(self, records: Records, start: float) -> dict[str, float | dict[str, float | None]]:
        """Return the mean distance of markers from where they were seen: in all, and by pose [mm]."""
        seen = self.seen.any(axis=2)
        away = MILLI * np.linalg.norm(self.errors(records), axis=2)
        each = {
            str(name): float(d[s].mean()) if s.any() else None
            for name, d, s in zip(self.along, away, seen, strict=True)
        }
        return {"mean_mm": float(away[seen].mean()), "poses_mm": each}

    def findings(self, records: Records, start: float) -> Iterator[str]:
        """Yield poses that end elsewhere than the data: far from them, beside the other poses and their own way."""
        places = self.observe(records)
        seen = self.seen.all(axis=2)
        error, moved = (
            np.ma.array(np.linalg.norm(each, axis=2), mask=~seen).mean(axis=1).filled(0.0)
            for each in (self.errors(records), np.where(self.seen, self.data - places[0], 0.0))
        )
        usual = float(np.median(error[seen.any(axis=1)])) if seen.any() else 0.0
        for name, off, way in zip(self.point_names, error, moved, strict=True):
            if off > ELSEWHERE * usual and off > FAR * way:
                yield (
                    f"{name} ends {MILLI * off:.3g} mm from where it was seen, most others within {MILLI * usual:.3g} "
                    "mm: the body may rest in several places under these loads, and was in another one, or loads of "
                    "this pose have another sign or unit; hold the pose out, or correct it"
                )


# --- the file ---------------------------------------------------------------------------------------------------------


Read = tuple[list[str], list[int], Array, set[str]]
"""Name of the pose of every line, the first line of every pose, positions (P, M, D), and the columns that were used."""


def _read_long(table: LoadTable, names: Sequence[str], dim: int, units: str | None) -> Read:
    """Read a table with a line for every marker and pose."""
    table.require(LABEL, "in a table with a column `marker`,")
    labels, of_line = table.texts(LABEL), table.texts("marker")
    _require_markers(table, names, set(of_line))
    axes = _axes_in({column: column for column in table.head}, dim, table)
    first_line: dict[str, int] = {}
    for k, pose in enumerate(labels):
        first_line.setdefault(pose, k)
    number, place = {pose: k for k, pose in enumerate(first_line)}, {name: k for k, name in enumerate(names)}
    values = np.full((len(number), len(names), dim), np.nan)
    columns = {axis: _metres(table, column, units) for axis, column in axes.items()}
    seen: dict[tuple[str, str], int] = {}
    for k, (pose, marker) in enumerate(zip(labels, of_line, strict=True)):
        first = seen.setdefault((pose, marker), k)
        if first != k:
            raise DataError(f"{table.source}:{table.lines[k]}: marker '{marker}' is there twice in pose '{pose}'")
        if marker in place:
            for axis, column in columns.items():
                values[number[pose], place[marker], axis] = column[k]
    return labels, list(first_line.values()), values, {"marker", *axes.values()}


def _read_wide(table: LoadTable, names: Sequence[str], dim: int, units: str | None) -> Read:
    """Read a table with a line for every pose."""
    labels = table.texts(LABEL) if LABEL in table.head else [str(k + 1) for k in range(len(table.rows))]
    if repeated := [label for label in labels if labels.count(label) > 1]:
        raise DataError(
            f"{table.source}: pose '{repeated[0]}' is there {labels.count(repeated[0])} times; in a table with a line "
            "for every marker, a column is called `marker`"
        )
    of_marker = {
        name: {
            column: column[len(name) + 1 :]
            for column in table.head
            if column.startswith(tuple(name + s for s in "_. "))
        }
        for name in names
    }
    found = {name for name, columns in of_marker.items() if any(_axis(rest) is not None for rest in columns.values())}
    _require_markers(table, names, found)
    values, used = np.full((len(table.rows), len(names), dim), np.nan), set()
    for m, name in enumerate(names):
        for axis, column in _axes_in(of_marker[name], dim, table).items():
            values[:, m, axis] = _metres(table, column, units)
            used.add(column)
    return labels, list(range(len(labels))), values, used


def _require_markers(table: LoadTable, names: Sequence[str], known: set[str]) -> None:
    for name in names:
        if name not in known:
            raise DataError(
                f"{table.source}: no marker '{name}'; it has {listed(sorted(known), 12)}" if known else
                f"{table.source}: has no markers: name them in a column `marker`, with x, y and z beside it, or in "
                f"columns such as {name}_x, {name}_y, {name}_z"
            )  # fmt: skip


def _axis(name: str) -> int | None:
    """Return the axis that the name of a column means."""
    name = split_unit(name, METRES)[0]
    return "xyz".index(name) if name in tuple("xyz") else None


def _axes_in(columns: Mapping[str, str], dim: int, table: LoadTable) -> dict[int, str]:
    """Return the column of each axis, from columns and what is left of their names."""
    found: dict[int, str] = {}
    for column, name in columns.items():
        axis = _axis(name)
        if axis is None:
            continue
        if axis >= dim:
            raise DataError(f"{table.source}: has a column '{column}', and the scene is {dim}D")
        if axis in found:
            raise DataError(f"{table.source}: '{found[axis]}' and '{column}' are the same axis: keep one")
        found[axis] = column
    if not found:
        raise DataError(f"{table.source}: has no positions: name their columns x, y and z, or x_mm, y_mm and z_mm")
    return found


def _metres(table: LoadTable, column: str, units: str | None) -> Array:
    """Return the numbers of a column of positions (n,) [m]."""
    return factor_of(column, METRES, units, "m", table.source) * table.numbers(column, missing=True)


def _require_same_loads(spec: Poses, table: LoadTable, labels: Sequence[str]) -> None:
    """Refuse a pose whose lines give several values of a load."""
    for column in spec.loads:
        values: dict[str, float] = {}
        for label, value, line in zip(labels, table.numbers(column).tolist(), table.lines, strict=True):
            if values.setdefault(label, value) != value:
                raise DataError(
                    f"{table.source}:{line}: pose '{label}' has {values[label]:g} and {value:g} as {column}: all "
                    "lines of a pose have the same loads"
                )

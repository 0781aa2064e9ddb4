"""Which columns of a table are strain, stress and time; what cannot be told is asked for by an option."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cqrun.errors import DataError, UsageError
from cqrun.explain import cut, listed, suggest
from cqrun.plugin.contract import Array
from cqrun.store.formats.cells import Numbers
from cqrun.tensile.columns import OPTICAL, ROLES, Column
from cqrun.tensile.tables import Table
from cqrun.tensile.units import UNITS, factor

STRAIN_SIDE = ("strain", "stretch", "true_strain", "extension")
STRESS_SIDE = ("stress", "true_stress", "force")
"""Roles that give one side of a curve, the most direct one first."""

SURELY_PERCENT, SURELY_FRACTION = 30.0, 3.0
"""No rubber has a strain above the first; few tests in percent end below the second."""

CONFIRMS = 0.02
"""Two columns agree if they differ by less than this part of the larger one."""


@dataclass(frozen=True)
class Chosen:
    """The columns that a curve is made of, with values in SI (n,) by role, and what was decided in words."""

    strain: Column | None
    stress: Column
    values: Mapping[str, Array]
    remarks: tuple[str, ...]


def choose(table: Table, rows: Sequence[int], columns: Mapping[str, str], units: Mapping[str, str]) -> Chosen:
    """Return the columns of a curve, and their values at some rows of the table.

    Args:
        table: the table.
        rows: indices of the rows.
        columns, units: of the options --column and --unit, by role.

    Raises:
        DataError: a column or a unit has to be given. UsageError: an option is wrong.
    """
    known = _with_options(table, columns)
    strain, stress = (_one_of(table, known, side, columns) for side in (STRAIN_SIDE, STRESS_SIDE))
    time = next((column for column in known if column.role == "time"), None)
    if stress is None or (strain is None and time is None):
        missing = "stress or force" if stress is None else "strain, stretch or extension"
        raise DataError(f"{table.source}: no column is recognised as {missing}; {_offer(table)}")
    remarks: list[str] = []
    read = _numbers(table, rows, known, remarks)
    values = {stress.role: read[stress.place] * _unit(table, stress, units)}
    if strain is not None:
        times = _unit_of_strain(table, strain, units, read, known, remarks)
        values[strain.role] = read[strain.place] * times
    if time is not None:
        values["time"] = read[time.place] * _unit_of_time(table, time, units, remarks)
    used = [column for column in (strain, stress) if column is not None]
    said = [f"{_words(c.role)}: column {c.label}" for c in used]
    if time is not None:
        said.append(f"time: column {time.label} in {units.get('time', time.unit or 's')}")
    remarks.insert(0, "read as " + " and ".join(said))
    return Chosen(strain, stress, values, tuple(remarks))


def _with_options(table: Table, columns: Mapping[str, str]) -> list[Column]:
    """Return the columns with the roles that options give them; a role that is given belongs to no other column."""
    found = list(table.columns)
    for role, name in columns.items():
        if role not in ROLES:
            raise UsageError(f"--column {role}={name}: a column can be {listed(ROLES)}{suggest(role, ROLES)}")
        names = [column.name.lower() for column in table.columns]
        if name.isdigit() and 1 <= int(name) <= len(found):
            place = int(name) - 1
        elif names.count(name.lower()) == 1:
            place = names.index(name.lower())
        else:
            raise UsageError(f"--column {role}={name}: {table.source} has no such column; {_offer(table)}")
        found = [replace(c, role="" if c.role == role else c.role) for c in found]
        found[place] = replace(found[place], role=role)
    return found


def _one_of(table: Table, known: Sequence[Column], side: Sequence[str], given: Mapping[str, str]) -> Column | None:
    """Return the most direct column of one side of the curve.

    Raises:
        DataError: two are equally direct.
    """
    asked = [role for role in side if role in given]
    for role in asked or side:
        found = [column for column in known if column.role == role]
        if side is STRAIN_SIDE:
            found = [column for column in found if column.strain_by == OPTICAL] or found
        if len(found) > 1:
            names = listed(column.label for column in found)
            raise DataError(
                f"{table.source}: columns {names} may all be the {_words(role)}: choose with "
                f"--column {role}={found[0].place + 1}"
            )
        if found:
            return found[0]
    return None


def _offer(table: Table) -> str:
    columns = listed(column.label for column in table.columns)
    return f"columns: {columns}; say what they are, such as --column strain=1 --column stress=2"


def _words(role: str) -> str:
    return {"strain": "engineering strain", "stress": "engineering stress"}.get(role, role.replace("_", " "))


def _numbers(table: Table, rows: Sequence[int], known: Sequence[Column], remarks: list[str]) -> dict[int, Array]:
    """Return the values of the columns that have a role, by place; cells that are no numbers are told, and missing."""
    used = [column for column in known if column.role]
    numbers = Numbers([c.place for c in used], [f"column {c.label}" for c in used], table.separator, table.source)
    words = {(k, column.place) for column in used for k in table.words(column, rows)}
    cells = {k: list(table.rows[k].cells) for k in rows}
    if words:
        first, place = min(words)
        count = f"{len(words)} cells are no numbers and count" if len(words) > 1 else "1 cell is no number and counts"
        where = f"'{cut(cells[first][place])}' at {table.source}:{table.rows[first].line}"
        remarks.append(f"{count} as missing (first: {where})")
    for k, place in words:
        cells[k][place] = ""
    values = np.array([numbers.row(cells[k], table.rows[k].line) for k in rows])
    numbers.finish()
    return {column.place: values[:, k] for k, column in enumerate(used)}


def _unit(table: Table, column: Column, units: Mapping[str, str]) -> float:
    """Return the factor to SI of a column.

    Raises:
        DataError: it has no unit. UsageError: the unit that was given does not exist.
    """
    kind, unit = ROLES[column.role], units.get(column.role, column.unit)
    times = factor(kind, unit) if unit else None
    if times is None and column.role in units:
        raise UsageError(f"--unit {column.role}={unit}: the units of a {kind} are {listed(UNITS[kind])}")
    if times is None:
        has = f"the unit '{unit}', which is not one of a {kind}" if unit else "no unit"
        example = {"stress": "MPa", "force": "N", "length": "mm", "time": "min"}[kind]
        raise DataError(
            f"{table.source}: column {column.label}, the {_words(column.role)}, has {has}: give it, such as "
            f"--unit {column.role}={example} ({listed(UNITS[kind])})"
        )
    return times


def _unit_of_time(table: Table, column: Column, units: Mapping[str, str], remarks: list[str]) -> float:
    """Return the factor to seconds of the time; a time without a unit is in seconds, and that is told.

    Raises:
        DataError: its unit is not known. UsageError: the unit that was given does not exist.
    """
    if column.unit or "time" in units:
        return _unit(table, column, units)
    remarks.append("the time has no unit and is read as seconds; if it is in minutes, give --unit time=min")
    return 1.0


def _unit_of_strain(
    table: Table, column: Column, units: Mapping[str, str], read: Mapping[int, Array], known: Sequence[Column],
    remarks: list[str],
) -> float:  # fmt: skip
    """Return the factor to SI of the column with the strain, stretch or extension.

    Raises:
        DataError: without a unit it can be percent or a fraction.
    """
    if column.role == "extension":
        return _unit(table, column, units)
    unit = units.get(column.role, column.unit)
    if unit:
        times = factor("strain", unit)
        if times is None:
            raise UsageError(f"{table.source}: '{unit}' is no unit of a strain; legal: {listed(UNITS['strain'])}")
        reached = times * float(np.nanmax(np.abs(read[column.place]), initial=0.0))
        if reached > SURELY_PERCENT and column.role not in units:
            raise DataError(
                f"{table.source}: column {column.label} has the unit '{unit}' and reaches {100 * reached:.4g} %: if it "
                f"is in percent, give --unit {column.role}=%; if not, --unit {column.role}=1"
            )
        return times
    if column.role == "stretch":
        return 1.0
    strain, option = read[column.place], f"--unit {column.role}"
    largest = float(np.nanmax(np.abs(strain), initial=0.0))
    if (times := _confirmed(column, strain, read, known)) is not None:
        what = "a fraction" if times == 1.0 else "percent"
        remarks.append(f"the strain has no unit; it is {what}, as another column confirms")
        return times
    if largest > SURELY_FRACTION:
        doubt = "which can only be percent" if largest > SURELY_PERCENT else "which may be percent or a fraction"
        raise DataError(
            f"{table.source}: column {column.label} reaches {largest:.4g} and has no unit, {doubt}: give {option}=% "
            f"for {largest:.4g} %, or {option}=1 for {100 * largest:.4g} %"
        )
    remarks.append(
        f"the strain has no unit; it reaches {largest:.3g} and is read as a fraction ({100 * largest:.3g} %)"
    )
    return 1.0


def _confirmed(column: Column, strain: Array, read: Mapping[int, Array], known: Sequence[Column]) -> float | None:
    """Return the factor that another column of the strain confirms, or None."""
    if column.role != "strain":
        return None
    for other in known:
        if other.role not in ("true_strain", "stretch") or other.place not in read or factor("strain", other.unit):
            continue
        for times in (1.0, 1e-2):
            with np.errstate(all="ignore"):
                expected = np.log1p(times * strain) if other.role == "true_strain" else 1.0 + times * strain
                apart = np.abs(read[other.place] * (times if other.role == "true_strain" else 1.0) - expected)
            rest = 1.0 if other.role == "stretch" else 0.0
            if np.nanmedian(apart) < CONFIRMS * np.nanmax(np.abs(expected - rest)):
                return times
    return None

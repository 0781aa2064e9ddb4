"""Make curves of a table: which rows are which test, its mode, and stretch and nominal stress from what was measured.

For a body that keeps its volume, in all three modes: P = sigma / l with the true stress sigma and the stretch l.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.errors import DataError
from cqrun.explain import cut, listed
from cqrun.materials.curves import MODES, Mode
from cqrun.plugin.contract import Array
from cqrun.store.formats.cells import NAN
from cqrun.store.formats.text import number_in
from cqrun.tensile.columns import CROSSHEAD, strain_by
from cqrun.tensile.curve import Curve, Given
from cqrun.tensile.meaning import Chosen, choose
from cqrun.tensile.tables import Table, facts, read_table
from cqrun.tensile.units import factor

MODE_WORDS: dict[Mode, re.Pattern[str]] = {
    "planar": re.compile(r"planar|pure[ _-]?shear|plane strain"),
    "equibiaxial": re.compile(r"bi-?axial|bulge|inflation"),
    "uniaxial": re.compile(
        r"uni-?axial|tensile|tension|zugversuch|traction|pull[ -]to[ -]failure|compressi|druckversuch|"
        r"d[ -]?412|d[ -]?638|d[ -]?882|d[ -]?575|iso[ -]?37\b|iso[ -]?527|iso[ -]?7743|din[ -]?53504"
    ),
}
"""What names a mode in a header, a column or a file's name; the first that is found counts."""

_COMPRESSION = re.compile(
    r"compression test|test\W{0,3}compression|compressive|druckversuch|stauchung|d[ -]?575|iso[ -]?7743"
)
_COMPRESSED = re.compile(r"compress|stauch|druck(spannung|kraft|versuch|verformung|dehnung)")
_PULLED = re.compile(r"tensi|zug|traction|pull")
"""What names compression and tension in a column's name, in a cell that names the test, or in a file's name."""

_LENGTH = re.compile(
    r"ga[u]?ge length|grip separation|clamp distance|specimen length|initial length|einspannl|messl|^l0$"
)
_AREA = re.compile(r"cross-?[ ]?section|area|querschnitt|^[as]0$")
_THICKNESS, _WIDTH = re.compile(r"thickness|dicke|[ée]paisseur"), re.compile(r"width|breite|largeur")
_SPECIMEN = re.compile(r"^(material|specimen|sample|probe|specimen name|sample name|material name)$")

SMALLEST_STRETCH = 0.2
"""No test compresses rubber to less than this part of its length."""

APART = 0.02
"""Two statements of an area that differ by more than this part contradict each other."""


@dataclass(frozen=True)
class _Named:
    """What the cells of a column say of a test."""

    mode: Mode
    compressed: bool
    pulled: bool


def read_curves(path: Path, given: Given) -> list[Curve]:
    """Return the curves in a file, as they were measured (cleaning.py cleans them).

    Raises:
        DataError: the file cannot be used as it is; the message says which option would help.
        UsageError: an option is wrong.
    """
    table = read_table(path)
    return [_curve(table, rows, named, given) for named, rows in _groups(table, given)]


def _groups(table: Table, given: Given) -> list[tuple[_Named | None, list[int]]]:
    """Return the rows of each test, and what a column says of it."""
    rows = list(range(len(table.rows)))
    texts = {column.name or str(column.place + 1): column for column in table.texts()}
    for name, value in given.only.items():
        if name not in texts:
            raise DataError(f"{table.source}: --only {name}={value}: columns with words are {listed(texts)}")
        place = texts.pop(name).place
        there = [table.rows[k].cells[place] for k in rows]
        rows = [k for k, cell in zip(rows, there, strict=True) if cell == value]
        if not rows:
            raise DataError(f"{table.source}: no row has '{value}' in '{name}'; there: {listed(dict.fromkeys(there))}")
    tests: dict[_Named | None, list[int]] = {}
    for name, column in texts.items():
        words = {cell: _named(cell) for cell in dict.fromkeys(table.rows[k].cells[column.place] for k in rows)}
        if len(words) == 1 and None in words.values():
            continue
        if None in words.values():
            raise DataError(
                f"{table.source}: column '{name}' has {listed(words)}: is this more than one material? Choose one with "
                f"--only {name}={next(iter(words))}"
            )
        for k in rows:
            tests.setdefault(words[table.rows[k].cells[column.place]], []).append(k)
        return list(tests.items())
    return [(None, rows)]


def _named(text: str) -> _Named | None:
    mode, words = _mode_in(text), text.lower()
    return None if mode is None else _Named(mode, bool(_COMPRESSED.search(words)), bool(_PULLED.search(words)))


def _mode_in(text: str) -> Mode | None:
    return next((mode for mode, pattern in MODE_WORDS.items() if pattern.search(text.lower())), None)


def _curve(table: Table, rows: Sequence[int], named: _Named | None, given: Given) -> Curve:
    chosen = choose(table, rows, given.columns, given.units)
    header = list(facts(table))
    words = " ".join(" ".join(cells) for cells in table.header).lower()
    words += " " + " ".join(column.name.lower() for column in table.columns)
    remarks = list(chosen.remarks)
    if table.after:
        first = table.after[0]
        count = "1 line" if len(table.after) == 1 else f"{len(table.after)} lines"
        where = f"line {first.line}: '{cut(table.separator.join(first.cells))}'"
        remarks.append(f"{count} after the table not read (first: {where})")
    mode = named.mode if named else given.of_file("mode", table.source) or _mode_of(table, words, remarks)
    stretch = _stretch(table, chosen, header, given, remarks)
    stress = _stress(table, chosen, stretch, header, given, remarks)
    positive = [bool(np.nanmedian(x) > 0.0) for x in (stretch - 1.0, stress) if np.isfinite(x).any()]
    if any(positive) and (why := _compressed(table, chosen, words, named, given, all(positive))):
        stretch, stress = 1.0 - np.abs(stretch - 1.0), -np.abs(stress)
        remarks.append(f"this is a compression test, {why}: its strain and stress count as negative")
    if np.nanmin(stretch, initial=1.0) <= 0.0:
        raise DataError(f"{table.source}: a strain of {np.nanmin(stretch) - 1:.4g} turns the specimen inside out")
    by = (chosen.strain.strain_by if chosen.strain else "") or strain_by(_about_strain(table))
    if chosen.strain is not None and chosen.strain.role == "extension" and not by:
        by = CROSSHEAD
    specimen = next((value for key, value, _ in header if _SPECIMEN.search(key)), "")
    lines = np.array([table.rows[k].line for k in rows])
    time = chosen.values.get("time")
    return Curve(table.source, mode, stretch, stress, lines, time, by, specimen, tuple(remarks))


def _compressed(table: Table, chosen: Chosen, words: str, named: _Named | None, given: Given, positive: bool) -> str:
    """Return what says that a test is a compression test whose signs are not written, or nothing.

    Raises:
        DataError: the file's name alone says so, and all is positive.
    """
    if given.compression is not None:
        return "as --compression says" if given.compression else ""
    if named is not None and (named.compressed or named.pulled):
        return "as a column says" if named.compressed else ""
    if _COMPRESSION.search(words):
        return "as the header says"
    columns = [column for column in (chosen.strain, chosen.stress) if column is not None]
    if found := [column.label for column in columns if _COMPRESSED.search(column.name.lower())]:
        return f"as the name of column {found[0]} says"
    if positive and _COMPRESSED.search(table.source.lower()):
        raise DataError(
            f"{table.source}: the file's name says compression, but strain and stress are positive: give "
            "--compression if they are written without minus signs (for all files of the command: beside tension "
            "tests, write the signs), or --no-compression if this is a tension test"
        )
    return ""


def _mode_of(table: Table, words: str, remarks: list[str]) -> Mode:
    for text, where in ((words, "the header"), (table.source.lower(), "the file's name")):
        if (mode := _mode_in(text)) is not None:
            remarks.append(f"{mode}, as {where} says")
            return mode
    raise DataError(
        f"{table.source}: nothing says which test this is: give --mode uniaxial, --mode planar or --mode equibiaxial "
        f"(for this file alone: --mode '{table.source}=planar')"
    )


def _about_strain(table: Table) -> str:
    """Return the header's lines on how the strain was measured, in lower case."""
    lines = (" ".join(cells).lower() for cells in table.header)
    return " ".join(line for line in lines if re.search(r"strain|extensomet|dehnung|d[ée]formation", line))


def _stretch(table: Table, chosen: Chosen, header: Sequence[Any], given: Given, remarks: list[str]) -> Array:
    if chosen.strain is None:
        return np.full(len(next(iter(chosen.values.values()))), NAN)
    role = chosen.strain.role
    values = chosen.values[role]
    if role == "stretch":
        if np.nanmin(values) < SMALLEST_STRETCH:
            raise DataError(
                f"{table.source}: column {chosen.strain.label} goes from {np.nanmin(values):.4g} to "
                f"{np.nanmax(values):.4g}, and a stretch is 1 at rest: if it is a strain, give --column "
                f"strain={chosen.strain.place + 1}"
            )
        return values
    if role == "true_strain":
        return np.exp(values)
    if role == "strain":
        return 1.0 + values
    length = given.of_file("gauge", table.source)
    if length is None:
        length = _of_header(header, _LENGTH, "length")
        if length is None:
            raise DataError(f"{table.source}: an extension needs the length at rest: give it, such as --gauge 33mm")
        remarks.append(f"length at rest {1e3 * length:.4g} mm, as the header says")
    return 1.0 + values / length


def _stress(
    table: Table, chosen: Chosen, stretch: Array, header: Sequence[Any], given: Given, remarks: list[str]
) -> Array:
    role, values = chosen.stress.role, chosen.values[chosen.stress.role]
    if role == "stress":
        return values
    if role == "true_stress":
        return values / stretch
    area = given.of_file("area", table.source)
    if area is None:
        area = _area(table, header)
        remarks.append(f"cross-section {1e6 * area:.4g} mm2, as the header says")
    return values / area


def _area(table: Table, header: Sequence[Any]) -> float:
    """Return the cross-section [m^2] that the header gives.

    Raises:
        DataError: it gives none, or two that differ.
    """
    whole = _of_header(header, _AREA, "area")
    sides = [_of_header(header, pattern, "length") for pattern in (_THICKNESS, _WIDTH)]
    product = sides[0] * sides[1] if sides[0] is not None and sides[1] is not None else None
    if whole is not None and product is not None and abs(whole - product) > APART * max(whole, product):
        raise DataError(
            f"{table.source}: the header gives a cross-section of {1e6 * whole:.4g} mm2, and thickness times width is "
            f"{1e6 * product:.4g} mm2: give the right one with --area"
        )
    area = whole if whole is not None else product
    if area is None:
        raise DataError(f"{table.source}: a force needs the cross-section at rest: give it, such as --area 18mm2")
    return area


def _of_header(header: Sequence[Any], pattern: re.Pattern[str], kind: str) -> float | None:
    """Return the first value [SI] of the header whose key fits and whose unit is of a kind."""
    for key, value, unit in header:
        number, times = number_in(value), factor(kind, unit) if unit else None
        if pattern.search(key) and number is not None and times is not None and number > 0.0:
            return number * times
    return None


def modes_in(curves: Sequence[Curve]) -> list[Mode]:
    """Return the modes of curves, in the usual order."""
    return [mode for mode in MODES if any(curve.mode == mode for curve in curves)]

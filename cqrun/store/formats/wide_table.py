"""Wide tables: a line for each frame, with a column for the time and one for each coordinate of each marker.

    time,tip_x,tip_y,base_x,base_y          tip.x, tip:x, tip x, tip-x, tip/x, tip[x] and tipX mean the same
    0.00,0.14,0.05,0.04,0.02

A unit may stand at the end of a column's name or before the axis: `time [ms]`, `tip_x_mm`, `tip [mm] x`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cqrun.errors import DataError
from cqrun.explain import listed
from cqrun.measurements.recording import Recording, columns, unit_of
from cqrun.store.formats.frames import AXES, Layout, read_frames
from cqrun.store.formats.text import PAGE, SEPARATORS, after, header_of, is_comment, split, stripped
from cqrun.store.formats.unreadable import other_format

SECONDS = {word: factor for factor, words in (
    (1.0, ("s", "sec", "secs", "second", "seconds")), (1e-3, ("ms", "msec", "millisecond", "milliseconds")),
) for word in words}  # fmt: skip
"""Units of times."""

LONGEST_NAME = 200
"""No column's name is longer."""

_TIME = re.compile(r"(?:time|t|zeit|temps|tiempo|tempo)(?:[ _]?[\[(/ _]([a-z]+)[\])]?)?")
_FRAME = re.compile(r"(?:sub ?)?frames?[ _#]*(?:number|nr|no|id|index)?\.?|index|sample")
_UNIT_IN_BRACKETS = re.compile(r"([^\[(]*[^\[( ]) ?[\[(] ?([A-Za-z]+) ?[\])]")
_UNIT_AT_END = re.compile(r"(.+)[_ ](mm|cm|m)")
_AXIS_ALONE = re.compile(r"()([xyzXYZ])")
_AXIS = re.compile(r"(.*?)(?:[ _.:/-]+([xyzXYZ])|(?<=[a-z0-9])([XYZ])|[\[(]([xyzXYZ])[\])])")


@dataclass(frozen=True)
class Column:
    """A column with a coordinate: which marker, which axis, and the unit in its name, or None."""

    marker: str
    axis: int
    unit: str | None


def coordinate(text: str) -> Column | None:
    """Return which coordinate a column has, by its name, or None."""
    text = " ".join(text.split())
    if len(text) > LONGEST_NAME:
        return None
    text, unit = _without_unit(text, anywhere=True)
    match = _AXIS.fullmatch(text) or _AXIS_ALONE.fullmatch(text)
    if match is None:
        return None
    axis = next(group for group in match.groups()[1:] if group)
    marker, inner = _without_unit(match[1], anywhere=False)
    return Column(marker.strip(), AXES.index(axis.lower()), unit or inner)


def _without_unit(text: str, *, anywhere: bool) -> tuple[str, str | None]:
    """Return the name of a column without the length unit at its end, and the unit; outside brackets if `anywhere`."""
    for pattern in (_UNIT_IN_BRACKETS, *([_UNIT_AT_END] if anywhere else [])):
        match = pattern.fullmatch(text)
        if match and unit_of(match[2]):
            return match[1], unit_of(match[2])
    return text, None


def read_wide(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read a wide table; a marker whose cells are empty or nan was not seen.

    Blank lines and lines that begin with `#` are skipped, and columns that are neither the time nor a coordinate are
    not read. `units` overrides the unit in the names of columns; without either, positions are in metres.

    Raises:
        DataError: the header or a line is wrong; the message names it and what would be right.
    """
    number, line = header_of(path, source)
    separator = max(SEPARATORS, key=lambda each: sum(coordinate(cell) is not None for cell in split(line, each)))
    head = stripped(split(line, separator))
    found = {place: column for place, cell in enumerate(head) if (column := coordinate(cell)) is not None}
    clock = [place for place, cell in enumerate(head) if _second(cell) is not None]
    if not found or not clock or "marker" in map(str.lower, head):
        raise DataError(f"{source}{_wrong_header(path, head, line, bool(found), f':{number}: ')}")
    if len(clock) > 1:
        raise DataError(f"{source}:{number}: the columns {_quoted(head, clock)} are both times: keep one")
    layout, unit = _layout(found, head, clock[0], names, f"{source}:{number}", source)
    lines = ((number, line) for number, line in after(path, source, number) if not is_comment(line))
    frames = read_frames(lines, layout, separator, source)
    assert frames.clock is not None
    time = frames.clock * (_second(head[clock[0]]) or 1.0)
    return frames.recording(time, units or unit or "m", layout.names, source)


def _second(text: str) -> float | None:
    """Return the unit of a column of times [s], or None for another column."""
    match = _TIME.fullmatch(" ".join(text.split()).lower()) if len(text) < LONGEST_NAME else None
    return SECONDS.get(match[1] or "s") if match else None


def _layout(
    found: dict[int, Column], head: Sequence[str], clock: int, names: Sequence[str] | None, at: str, source: str
) -> tuple[Layout, str | None]:
    """Return where the chosen markers are, and the unit of their columns."""
    places: dict[str, dict[int, int]] = {}
    for place, column in found.items():
        axes = places.setdefault(column.marker, {})
        if column.axis in axes:
            raise DataError(f"{at}: the columns {_quoted(head, [axes[column.axis], place])} are the same: keep one")
        axes[column.axis] = place
    if "" in places:
        raise DataError(
            f"{at}: the columns {_quoted(head, places[''].values())} do not say which marker they are of: write tip_x, "
            f"tip_y, ... for a marker 'tip', or time,marker,x,y,z with a line for each marker and frame; {PAGE}"
        )
    labels = tuple(places)
    chosen = [labels[k] for k in columns(labels, names, source)]
    dim = 3 if any(2 in places[name] for name in chosen) else 2
    for name in chosen:
        if missing := [AXES[axis] for axis in range(dim) if axis not in places[name]]:
            raise DataError(
                f"{at}: marker '{name}' has columns for {_axes(places[name])} and not for {listed(missing)}: a marker "
                "has x and y, or x, y and z as all others"
            )
    used = tuple(tuple(places[name][axis] for axis in range(dim)) for name in chosen)
    by_unit = {found[place].unit: place for marker in used for place in marker}
    if len(by_unit) > 1:
        raise DataError(f"{at}: the columns {_quoted(head, by_unit.values())} have different units: use one unit")
    return Layout(tuple(chosen), used, len(head), clock), next(iter(by_unit))


def _wrong_header(path: Path, head: Sequence[str], line: str, has_positions: bool, at: str) -> str:
    """Return what is wrong with a header, which is a line of the file, and where."""
    if other := other_format(path):
        return f": {other}"
    shown = line.strip()[:80]
    if has_positions and "marker" not in map(str.lower, head):
        if any(_FRAME.fullmatch(cell.lower()) for cell in head if len(cell) < LONGEST_NAME):
            return (
                f"{at}the table has numbers of frames and no times: add a column 'time' in seconds, which is the frame "
                "divided by the frames per second"
            )
        return f"{at}no column is called 'time', in '{shown}': name the column with the times [s] so; {PAGE}"
    return (
        f"{at}the first line must name the columns: time,marker,x,y,z with a line for each marker and frame (2D: "
        f"time,marker,x,y), or time,tip_x,tip_y,tip_z with a line for each frame; it is '{shown}'; {PAGE}"
    )


def _quoted(head: Sequence[str], places: Iterable[int]) -> str:
    return listed(f"'{head[place]}'" for place in places)


def _axes(places: dict[int, int]) -> str:
    return listed(AXES[axis] for axis in sorted(places))

"""CSV files of Vicon Nexus and Tracker: the section `Trajectories`.

    Trajectories
    100                                           frames per second
    ,,arm:tip,,,arm:base,,                        names, above the first coordinate of each marker
    Frame,Sub Frame,X,Y,Z,X,Y,Z
    ,,mm,mm,mm,mm,mm,mm
    1,0,140.02,45.1,126.3,46,20,89

Other sections, such as Devices, Joints and Model Outputs, may stand before and after it, with a blank line between
them. Columns of velocities (X') and accelerations (X'') are not read. The format has no public description; this one is
from files that Nexus 1.8 to 2.16 and Tracker have exported, such as those at https://ccu.uni-konstanz.de/wiki.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from cqrun.errors import DataError
from cqrun.explain import listed
from cqrun.measurements.recording import Recording, columns
from cqrun.store.formats.frames import Layout, read_frames, require_rate, require_unit
from cqrun.store.formats.text import SEPARATORS, is_blank, lines_of, number_in, split, stripped

BEGINS = re.compile(r'"?(Trajectories|Devices|Model Outputs|Joints|Segments)"?[\s,;]')

SECTION = "Trajectories"


def read_vicon(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read the trajectories of a file of Vicon; the time of the first frame is 0, whatever number it has.

    A marker with empty cells was not seen. `units` overrides the units in the file.

    Raises:
        DataError: there is no such section, or a line of it is wrong; the message names it and what would be right.
    """
    lines = lines_of(path, source)
    start = next((number for number, line in lines if _title(line) == SECTION), None)
    if start is None:
        raise DataError(f"{source}: a CSV file of Vicon without a section {SECTION}: export the trajectories, too")
    head = list(islice(lines, 4))
    if len(head) < 4:
        raise DataError(f"{source}:{start}: the file ends in the header of its trajectories; copy or export it again")
    separator = max(SEPARATORS, key=head[2][1].count)
    rate, labels, axes, of_column = (stripped(split(line, separator)) for _, line in head)
    per_second = require_rate(number_in(rate[0]), rate[0], f"{source}:{start + 1}")
    layout = _layout(labels, axes, of_column, f"{source}:{start + 3}")
    layout = layout.of(columns(layout.names, names, source))
    unit = units or _unit(layout, of_column, f"{source}:{start + 4}")
    frames = read_frames(_section(lines), layout, separator, source)
    clock = frames.clock
    assert clock is not None
    if (wrong := np.flatnonzero(clock != np.round(clock))).size:
        raise DataError(f"{source}:{frames.lines[wrong[0]]}: the frame is {clock[wrong[0]]:g}, not a whole number")
    return frames.recording((clock - clock[0]) / per_second, unit, layout.names, source)


def _title(line: str) -> str:
    """Return what stands in a line whose other cells are empty, if it is no number."""
    text = line.strip(' \t\r\n,;"')
    return "" if any(sign in text for sign in ",;\t") or number_in(text) is not None else text


def _section(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield the lines of a section: until a blank line with another title after it, or the end."""
    blank = False
    for number, line in lines:
        if blank and _title(line):
            return
        blank = is_blank(line)
        if not blank:
            yield number, line


def _layout(labels: Sequence[str], axes: Sequence[str], units: Sequence[str], at: str) -> Layout:
    """Return where the coordinates of markers are, from the lines that name the columns."""
    if [axis.lower() for axis in axes[:2]] != ["frame", "sub frame"]:
        raise DataError(f"{at}: must be 'Frame,Sub Frame,X,Y,Z,...', is '{','.join(axes)[:60]}'")
    starts = [k for k in range(2, len(axes) - 2) if [axis.upper() for axis in axes[k : k + 3]] == ["X", "Y", "Z"]]
    if not starts:
        raise DataError(f"{at}: has no columns X, Y, Z of a marker, only {listed(axes[2:], 8)}")
    names = [labels[k] if k < len(labels) else "" for k in starts]
    return Layout(
        tuple(name or f"unlabelled {k}" for k, name in enumerate(names)), tuple((k, k + 1, k + 2) for k in starts),
        max(len(labels), len(axes), len(units)), 0, "the frame",
    )  # fmt: skip


def _unit(layout: Layout, units: Sequence[str], at: str) -> str:
    """Return the unit of all coordinates."""
    words = {units[k] if k < len(units) else "" for place in layout.places for k in place}
    if len(words) > 1:
        raise DataError(f"{at}: the coordinates have the units {listed(sorted(words))}: use one unit")
    return require_unit(words.pop(), at)

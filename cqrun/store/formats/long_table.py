"""Long tables: a line for each marker and frame, `time,marker,x,y,z` (without `z` in 2D).

Numbers are written with `repr`, so that a written recording is read back bit for bit.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, columns
from cqrun.store.formats.cells import Numbers
from cqrun.store.formats.text import SEPARATORS, after, header_of, split, stripped
from cqrun.units import METRES

COLUMNS = ("time", "marker", "x", "y", "z")

SPARSEST, MANY = 100, 1_000_000
"""A table of so many places may have so many times as many places as lines."""


def is_long(header: str) -> bool:
    """Return whether the first line of a table is that of a long one."""
    return any(_is_head(_columns(header, separator)) for separator in SEPARATORS)


def read_long(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read a long table; a marker that has no line at some time, or nan, was not seen then.

    Lines may be sorted by time or by marker. Empty lines, and lines that begin with `#`, are skipped. Of markers that
    are not named only the times are kept.

    Raises:
        DataError: a line is wrong; the message names the line and what is wrong with it.
    """
    wanted = None if names is None else set(names)
    tracks: dict[str, dict[float, list[float]]] = {}
    times: set[float] = set()
    for time, name, position, at in _lines(path, source):
        times.add(time)
        track = tracks.setdefault(name, {})
        if wanted is None or name in wanted:
            _append(track, time, position, name, at)
    if not tracks:
        raise DataError(f"{source}: has a header but no data")
    labels = tuple(tracks)
    chosen = [labels[k] for k in columns(labels, names, source)]
    _require_frames(len(times), [len(tracks[name]) for name in chosen], source)
    frame = {time: i for i, time in enumerate(sorted(times))}
    positions = np.full((len(times), len(chosen), len(position)), np.nan)
    for marker, name in enumerate(chosen):
        positions[[frame[time] for time in tracks[name]], marker] = list(tracks[name].values())
    return Recording(np.array(list(frame)), tuple(chosen), METRES[units or "m"] * positions, source)


def _is_head(names: tuple[str, ...]) -> bool:
    return names in (COLUMNS, COLUMNS[:4])


def _columns(header: str, separator: str) -> tuple[str, ...]:
    return tuple(cell.lower() for cell in stripped(split(header, separator)))


def _lines(path: Path, source: str) -> Iterator[tuple[float, str, list[float], str]]:
    """Yield time, marker and position of each line, and how errors name the line."""
    header, line = header_of(path, source)
    separator = next(separator for separator in SEPARATORS if _is_head(_columns(line, separator)))
    dim = len(_columns(line, separator)) - 2
    numbers = Numbers([0, *range(2, dim + 2)], ["time", "x", "y", "z"], separator, source)
    first, rows = header, csv.reader((line for _, line in after(path, source, header)), delimiter=separator)
    try:
        for row in rows:
            if not _blank(row):
                number = first + rows.line_num
                yield *_row(row, dim, numbers, number, f"{source}:{number}"), f"{source}:{number}"
    except csv.Error as error:
        raise DataError(f"{source}: not a CSV text file ({error})") from error
    numbers.finish()


def _require_frames(times: int, lines: list[int], source: str) -> None:
    """Refuse a table that is almost empty: it would take far more memory than the file."""
    if times * len(lines) > SPARSEST * sum(lines) + MANY:
        raise DataError(
            f"{source}: {sum(lines):,} lines for {len(lines):,} markers at {times:,} times: hardly any two lines have "
            "the same time; all markers of a frame have one time"
        )


def write_csv(recording: Recording, path: Path) -> None:
    """Write a recording in metres and seconds; markers that were not seen are omitted."""
    time = recording.time.tolist()
    with path.open("w", newline="", encoding="utf-8") as lines:
        rows = csv.writer(lines, lineterminator="\n")
        rows.writerow(COLUMNS[: 2 + recording.dim])
        for t, frame, seen in zip(time, recording.positions.tolist(), recording.seen().tolist(), strict=True):
            shown = zip(recording.names, frame, seen, strict=True)
            rows.writerows([repr(t), name, *map(repr, x)] for name, x, here in shown if here)


def _blank(row: list[str]) -> bool:
    return not row or row[0].lstrip().startswith("#") or not any(cell.strip() for cell in row)


def _row(row: list[str], dim: int, numbers: Numbers, line: int, at: str) -> tuple[float, str, list[float]]:
    """Return time, marker and position of one line."""
    if len(row) != dim + 2:
        raise DataError(f"{at}: {len(row)} columns instead of {dim + 2}; is the file truncated?")
    time, *position = numbers.row(row, line)
    if not np.isfinite(time):
        raise DataError(f"{at}: the time is {time}; every line needs a time")
    missing = [x != x for x in position]
    if any(missing) and not all(missing):
        raise DataError(
            f"{at}: some coordinates of marker '{row[1].strip()}' are nan and some are not; "
            "a marker that was not seen has no coordinates"
        )
    return time, row[1].strip(), position


def _append(track: dict[float, list[float]], time: float, position: list[float], name: str, at: str) -> None:
    """Add a line to the track of its marker, in which time must increase."""
    if track:
        last = next(reversed(track))
        if time == last or time in track:
            raise DataError(f"{at}: marker '{name}' appears twice at time {time:.9g} s; remove one line")
        if time < last:
            raise DataError(
                f"{at}: time does not increase: marker '{name}' goes from {last:.9g} s back to {time:.9g} s"
            )
    track[time] = position

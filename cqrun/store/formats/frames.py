"""Tables with a line for every frame and columns for the coordinates of every marker, whatever program wrote them."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, unit_of
from cqrun.plugin.contract import Array
from cqrun.store.formats.cells import Numbers
from cqrun.store.formats.text import is_blank, split
from cqrun.units import METRES

AXES = "xyz"

ANOTHER_CLOCK = 0.1
"""Times and a frame rate contradict each other if they differ by this part of the rate."""


@dataclass(frozen=True)
class Layout:
    """Where the lines of a table have what.

    Attributes:
        names: M markers.
        places: column of each coordinate of each marker (M, D), from 0.
        width: how many columns a line has; more may follow if they are empty.
        clock: column with the time or the number of the frame; None if every line is the next frame.
        clock_is: what it is, in messages.
    """

    names: tuple[str, ...]
    places: tuple[tuple[int, ...], ...]
    width: int
    clock: int | None = None
    clock_is: str = "the time"

    def of(self, chosen: Sequence[int]) -> Layout:
        """Return the layout with only some of the markers."""
        return replace(self, names=tuple(self.names[k] for k in chosen), places=tuple(self.places[k] for k in chosen))


@dataclass(frozen=True)
class Frames:
    """What the lines of a table say.

    Attributes:
        clock: times or numbers of frames (T,); None if the table has none.
        positions: in the unit of the file (T, M, D); NaN where a marker was not seen.
        lines: number of each line in the file (T,).
    """

    clock: Array | None
    positions: Array
    lines: Array

    def recording(self, time: Array, unit: str, names: Sequence[str], source: str) -> Recording:
        """Return the recording, in metres and seconds; the positions are changed in place, as they may be large."""
        np.multiply(self.positions, METRES[unit], out=self.positions)
        return Recording(time, tuple(names), self.positions, source)


def read_frames(lines: Iterable[tuple[int, str]], layout: Layout, separator: str, source: str) -> Frames:
    """Read the lines of a table after its header; blank ones are skipped.

    Only the numbers that the layout names are kept, so the memory depends on them and not on the file.

    Raises:
        DataError: a line has other columns, a cell is no number, a frame has no time or time does not increase, a
            marker has some coordinates and not others, or there are no lines; the message names the line.
    """
    timed = [] if layout.clock is None else [layout.clock]
    places = [*timed, *(place for marker in layout.places for place in marker)]
    numbers = Numbers(places, _labels(layout), separator, source)
    clock, data, of_line = array("d"), array("d"), array("q")
    for number, line in lines:
        if is_blank(line) and (timed or separator not in line):  # a line of separators is a frame without any marker
            continue
        cells = split(line, separator)
        if len(cells) != layout.width:
            _require_width(cells, layout.width, separator, f"{source}:{number}")
        row = numbers.row(cells, number)
        of_line.append(number)
        clock.extend(row[: len(timed)])
        data.extend(row[len(timed) :])
    numbers.finish()
    if not of_line:
        raise DataError(f"{source}: has a header but no data")
    positions = np.frombuffer(data).reshape(len(of_line), len(layout.names), -1)
    frames = Frames(np.frombuffer(clock) if timed else None, positions, np.frombuffer(of_line, dtype=np.int64))
    _check_clock(frames, layout, source)
    _check_gaps(frames, layout, source)
    return frames


def _labels(layout: Layout) -> list[str]:
    coordinates = [f"{AXES[k]} of marker '{name}'" for name, p in _pairs(layout) for k in range(len(p))]
    return [*([] if layout.clock is None else [layout.clock_is]), *coordinates]


def _pairs(layout: Layout) -> Iterable[tuple[str, tuple[int, ...]]]:
    return zip(layout.names, layout.places, strict=True)


def _require_width(cells: Sequence[str], width: int, separator: str, at: str) -> None:
    """Refuse a line with fewer columns than the header, or with more that are not empty."""
    if len(cells) < width:
        raise DataError(f"{at}: {len(cells)} columns instead of {width}; is the file truncated?")
    if any(cell.strip() for cell in cells[width:]):
        decimal = "; if commas in numbers are decimal, separate the columns by semicolons" if separator == "," else ""
        raise DataError(f"{at}: {len(cells)} columns instead of {width}{decimal}")


def _check_clock(frames: Frames, layout: Layout, source: str) -> None:
    if frames.clock is None:
        return
    wrong = np.flatnonzero(~np.isfinite(frames.clock))
    if wrong.size:
        k = int(wrong[0])
        raise DataError(f"{source}:{frames.lines[k]}: {layout.clock_is} is {frames.clock[k]}; every line needs one")
    back = np.flatnonzero(np.diff(frames.clock) <= 0)
    if back.size:
        k = int(back[0])
        raise DataError(
            f"{source}:{frames.lines[k + 1]}: {layout.clock_is} does not increase: {frames.clock[k]:.9g} is followed "
            f"by {frames.clock[k + 1]:.9g}"
        )


def _check_gaps(frames: Frames, layout: Layout, source: str) -> None:
    for marker, name in enumerate(layout.names):
        missing = np.isnan(frames.positions[:, marker])
        half = np.flatnonzero(missing.any(axis=1) & ~missing.all(axis=1))
        if half.size:
            raise DataError(
                f"{source}:{frames.lines[half[0]]}: some coordinates of marker '{name}' are missing and some are not; "
                "a marker that was not seen has no coordinates"
            )


# --- what headers claim -----------------------------------------------------------------------------------------------


def require_unit(text: str, at: str) -> str:
    """Return the unit that a file names.

    Raises:
        DataError: it is not known.
    """
    unit = unit_of(text)
    if unit is None:
        what = f"is '{text[:40]}', which is not known" if text.strip() else "is missing"
        raise DataError(f"{at}: its length unit {what}; give it with `units: {' | '.join(METRES)}`")
    return unit


def require_rate(rate: float | None, text: str, at: str) -> float:
    """Return a frame rate; raise a DataError if it is none."""
    if rate is None or not rate > 0:
        raise DataError(f"{at}: the frame rate is '{text[:40]}'; it must be a positive number")
    return rate


def require_frames(there: int, promised: float | None, source: str) -> None:
    """Raise a DataError if a header promises more frames than there are."""
    if promised is not None and promised > there:
        raise DataError(
            f"{source}: truncated: its header promises {promised:.0f} frames and {there} are there; copy or export it "
            "again"
        )


def require_same_clock(time: Array, rate: float | None, source: str) -> None:
    """Raise a DataError if times are not those of the frame rate that a header has.

    Times may be rounded, which the mean does not see, and frames may be left out, which the median does not see.
    """
    if rate is None or len(time) < 2:
        return
    steps = np.array([np.median(np.diff(time)), (time[-1] - time[0]) / (len(time) - 1)])
    if (np.abs(steps * rate - 1.0) > ANOTHER_CLOCK).all():
        raise DataError(
            f"{source}: its header says {rate:g} frames per second, and its times are {steps[0]:.4g} s apart: correct "
            "one of them"
        )

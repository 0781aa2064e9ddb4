"""A recording of markers: names, times in seconds and positions in metres."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cqrun.errors import DataError
from cqrun.explain import listed, suggest
from cqrun.plugin.contract import Array
from cqrun.units import METRES

_SPELLINGS = {
    prefix + word: short + "m"
    for prefix, short in (("", ""), ("centi", "c"), ("milli", "m"))
    for word in ("meter", "meters", "metre", "metres")
}


FARTHEST = 1e6
"""No camera sees a marker that is farther away [m]; one that is 1 km away and given in mm is nearer."""

LATEST = 1e12
"""No clock shows a later time [s]."""


@dataclass(frozen=True)
class Recording:
    """Positions of markers over time.

    Attributes:
        time: strictly increasing times (T,) [s].
        names: M labels, in the order of the file; a C3D file may repeat one.
        positions: positions in the axes of the recording (T, M, D) [m]; NaN where a marker was not seen.
        source: name of the recording in error messages.
    """

    time: Array
    names: tuple[str, ...]
    positions: Array
    source: str

    @property
    def dim(self) -> int:
        """Number of coordinates, 2 or 3."""
        return int(self.positions.shape[2])

    def seen(self) -> Array:
        """Return where each marker was seen: (T, M) of bool."""
        return ~np.isnan(self.positions).any(axis=2)

    def select(self, names: Sequence[str]) -> Recording:
        """Return the recording with only the markers `names`, in that order.

        Raises:
            DataError: no names, a name that is not in the recording, or one that appears more than once.
        """
        return replace(self, names=tuple(names), positions=self.positions[:, columns(self.names, names, self.source)])


def columns(labels: Sequence[str], names: Sequence[str] | None, source: str) -> list[int]:
    """Return where the markers `names` are among a recording's labels, in that order; all of them for None.

    Raises:
        DataError: no names, a name that is not among the labels, or one that appears more than once.
    """
    if names is None:
        return list(range(len(labels)))
    if not names:
        raise DataError(
            f"{source}: `markers` is missing: name markers of the recording and where each is at rest in the scene, "
            f"such as {labels[0]}: [x, y, z]; it has {listed(labels, 8)}"
        )
    counts = Counter(labels)
    for name in names:
        if counts[name] == 0:
            known = listed((f"'{label}'" for label in counts), 12)
            raise DataError(f"{source}: no marker '{name}'{_meant(name, labels)}; it has {known}")
        if counts[name] > 1:
            raise DataError(
                f"{source}: marker '{name}' appears {counts[name]} times; rename or remove the others in the recording"
            )
    place = {label: k for k, label in enumerate(labels)}
    return [place[name] for name in names]


def _meant(name: str, labels: Sequence[str]) -> str:
    """Return ` (did you mean 'x'?)` for a label with the name of a subject, such as `arm:tip`, or a similar one."""
    of_subject = [label for label in labels if label.rpartition(":")[2] == name]
    return f" (did you mean '{of_subject[0]}'?)" if of_subject else suggest(name, labels)


def check_recording(recording: Recording) -> Recording:
    """Return `recording` if its times increase and its positions can be measured, or are missing.

    Raises:
        DataError: a frame or marker is wrong; the message says which.
    """
    _check_time(recording.time, recording.source)
    _check_positions(recording)
    return recording


def _check_time(time: Array, source: str) -> None:
    if time.size < 2:
        raise DataError(f"{source}: {time.size} frames; a recording needs 2 or more")
    if not np.isfinite(time).all():
        frame = int(np.flatnonzero(~np.isfinite(time))[0])
        raise DataError(f"{source}: the time of frame {frame} is {time[frame]}; every frame needs a time")
    late = np.flatnonzero(np.abs(time) > LATEST)
    if late.size:
        frame = int(late[0])
        raise DataError(f"{source}: the time of frame {frame} is {time[frame]:.3g} s; times are in seconds")
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        k = int(back[0])
        raise DataError(
            f"{source}: time does not increase: frame {k} is at {time[k]:.9g} s and "
            f"frame {k + 1} at {time[k + 1]:.9g} s"
        )


def _check_positions(recording: Recording) -> None:
    """Refuse coordinates that no camera measures: infinite or far ones, and NaN beside numbers."""
    positions, missing = recording.positions, np.isnan(recording.positions)
    far = np.abs(positions) > FARTHEST
    half = missing.any(axis=2) & ~missing.all(axis=2)
    wrong = np.argwhere(far.any(axis=2) | half)
    if not len(wrong):
        return
    frame, marker = wrong[0]
    at = f"{recording.source}: marker '{recording.names[marker]}' in frame {frame} ({recording.time[frame]:.6g} s)"
    if half[frame, marker]:
        raise DataError(
            f"{at}: some coordinates are nan and some are not; a marker that was not seen has no coordinates"
        )
    if np.isinf(positions[frame, marker]).any():
        raise DataError(f"{at}: it is at infinity; omit a marker that was not seen, or write nan")
    distance = float(np.abs(positions[frame, marker]).max())
    raise DataError(f"{at}: it is {distance:.3g} m away, which no camera sees: the file is damaged, or the unit wrong")


def unit_of(text: str) -> str | None:
    """Return `m`, `cm` or `mm` for the name of a unit in a file, or None for any other name."""
    word = text.strip().lower()
    word = _SPELLINGS.get(word, word)
    return word if word in METRES else None

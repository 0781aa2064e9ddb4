"""A recording of markers: names, times in seconds and positions in metres."""

from __future__ import annotations

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
            DataError: a name is not in the recording, or appears more than once.
        """
        columns = []
        for name in names:
            matching = [i for i, label in enumerate(self.names) if label == name]
            if not matching:
                known = listed((f"'{label}'" for label in dict.fromkeys(self.names)), 12)
                raise DataError(f"{self.source}: no marker '{name}'{suggest(name, self.names)}; it has {known}")
            if len(matching) > 1:
                raise DataError(
                    f"{self.source}: marker '{name}' appears {len(matching)} times; "
                    "rename or remove the others in the recording"
                )
            columns.append(matching[0])
        return replace(self, names=tuple(names), positions=self.positions[:, columns])


def check_recording(recording: Recording) -> Recording:
    """Return `recording` if its times increase and its positions are finite or missing.

    Raises:
        DataError: a frame or marker is wrong; the message says which.
    """
    time, positions, source = recording.time, recording.positions, recording.source
    if time.size < 2:
        raise DataError(f"{source}: {time.size} frames; a recording needs 2 or more")
    if not np.isfinite(time).all():
        frame = int(np.flatnonzero(~np.isfinite(time))[0])
        raise DataError(f"{source}: the time of frame {frame} is {time[frame]}; every frame needs a time")
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        k = int(back[0])
        raise DataError(
            f"{source}: time does not increase: frame {k} is at {time[k]:.9g} s and "
            f"frame {k + 1} at {time[k + 1]:.9g} s"
        )
    if np.isinf(positions).any():
        frame, marker, _ = (int(i[0]) for i in np.nonzero(np.isinf(positions)))
        raise DataError(
            f"{source}: marker '{recording.names[marker]}' is at infinity in frame {frame}; "
            "omit a marker that was not seen, or write nan"
        )
    return recording


def unit_of(text: str) -> str | None:
    """Return `m`, `cm` or `mm` for the name of a unit in a file, or None for any other name."""
    word = text.strip().lower()
    word = _SPELLINGS.get(word, word)
    return word if word in METRES else None

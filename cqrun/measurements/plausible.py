"""Measurements that no body could make: gaps written as zeros, leaps, exchanged labels, held positions, other units.

A marker on a body moves little from one frame to the next. Camera systems make sudden errors: they lose a marker and
write zeros or its last position, or take one marker for another. Frames that are certainly wrong are taken as not seen,
what cannot be mended so is refused, and what is only odd is reported. Nothing else is changed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cqrun.measurements.gaps import coincident, held, stopped, zeros
from cqrun.measurements.leaps import leaps, refuse_other_units
from cqrun.measurements.recording import Recording
from cqrun.measurements.track import take_out

SLACK = 1e-6
"""Of the span, in frames."""

FEW = 0.05
"""In this part of the frames the markers may be together by an error."""


def plausible(recording: Recording, reach: float, span: tuple[float, float]) -> tuple[Recording, tuple[str, ...]]:
    """Return a recording without what no body could do, and sentences on what is wrong or odd.

    Args:
        recording: of the markers that are used.
        reach: how far the body is across [m].
        span: first and last time that count [s].

    Raises:
        DataError: a unit changes, markers exchange their places for good, or one leaps farther than the body is across
            and stays there.
    """
    time = recording.time
    slack = SLACK * float(time[-1] - time[0]) / (len(time) - 1)
    begin, end = (int(k) for k in np.searchsorted(time, [span[0] - slack, span[1] + slack]))
    part = replace(recording, time=time[begin:end], positions=recording.positions[begin:end].copy())
    doubts = take_out(part, zeros(part, reach))
    size = max(reach, _extent(part))
    refuse_other_units(part, size, begin)
    doubts += take_out(part, held(part, size))
    doubts += take_out(part, leaps(part, size, begin))
    doubts += [*stopped(part, size), *coincident(part)]
    positions = recording.positions.copy()
    positions[begin:end] = part.positions
    return replace(recording, positions=positions), tuple(doubt.sentence(recording, begin) for doubt in doubts)


def _extent(recording: Recording) -> float:
    """Return how far apart the markers are [m], in whatever unit the recording is.

    Some markers may be far away in some frames, and not all are seen in all frames.
    """
    count = recording.seen().sum(axis=1)
    x = recording.positions[count == count.max(initial=1)]
    if not len(x):
        return 0.0
    return float(np.quantile(np.linalg.norm(np.nanmax(x, axis=1) - np.nanmin(x, axis=1), axis=1), FEW))

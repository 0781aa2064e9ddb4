"""Sudden motions: of all markers, because the unit changes, and of single markers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording
from cqrun.measurements.track import LABEL, SAME, Doubt, Track, track_of

SUDDEN, SMALL = 10.0, 0.05
"""A step is sudden if it is so many times as long as its neighbours' median, and longer than this part of the body."""

FEWEST = 6
"""A track of fewer positions is not judged."""

UNIT = 0.02
"""Largest difference of a ratio from a power of ten, in decades, where a unit changes."""


def refuse_other_units(recording: Recording, size: float, begin: int) -> None:
    """Refuse a recording whose positions all change by a power of ten from one frame to the next."""
    x, time = recording.positions, recording.time
    distance = np.linalg.norm(x, axis=2)
    usable = (distance[1:] > 0) & (distance[:-1] > 0)  # NaN is not
    decades = np.zeros(usable.shape)
    np.log10(distance[1:] / np.where(usable, distance[:-1], 1.0), out=decades, where=usable)
    power = np.round(decades)
    far = np.linalg.norm(np.diff(x, axis=0), axis=2) > SMALL * size
    fits = (np.abs(decades - power) < UNIT) & (np.abs(power) >= 1) & (np.abs(power) <= 3)
    changes = (fits | ~usable).all(axis=1) & (fits & far).any(axis=1)
    for k in np.flatnonzero(changes):
        if len(set(power[k][usable[k]])) == 1:
            factor = 10.0 ** float(power[k][usable[k]][0])
            raise DataError(
                f"{recording.source}: from frame {begin + k + 1} ({time[k + 1]:.6g} s) on all positions are "
                f"{factor:g} times what they were before: the unit changes; write the whole file in one unit"
            )


def leaps(recording: Recording, size: float, begin: int) -> Iterator[Doubt]:
    """Yield the sudden motions of every marker; refuse those that cannot be mended."""
    for marker in range(len(recording.names)):
        track = track_of(recording, marker)
        if len(track.x) < FEWEST:
            continue
        sudden = [int(k) for k in np.flatnonzero(track.steps > np.maximum(SUDDEN * track.usual, SMALL * size))]
        while sudden:
            first = sudden.pop(0)
            last = next((k for k in sudden if _comes_back(track, first, k)), None)
            if last is not None:
                sudden = [k for k in sudden if k > last]
                yield _away(recording, marker, track, (first, last), size)
            elif track.alone(first, first):
                yield _moved(recording, marker, track, first, size, begin)


def _comes_back(track: Track, first: int, last: int) -> bool:
    """Say whether a marker is away after the step `first` and is back after the step `last`."""
    back = np.linalg.norm(track.x[last + 1] - track.x[first]) <= SAME * min(track.leaps[first], track.leaps[last])
    return bool(back) and last - first <= len(track.x) // 2 and track.alone(first, last)


def _away(recording: Recording, marker: int, track: Track, steps: tuple[int, int], size: float) -> Doubt:
    """Return what is wrong with a marker that goes away and comes back."""
    first, last = steps
    frames, leap = track.frames[first + 1 : last + 1], min(track.leaps[first], track.leaps[last])
    other = _place_of(recording, marker, track, first)
    if other is not None:
        return Doubt(marker, frames, f"is where '{recording.names[other]}' was just before")
    if leap > size:
        return Doubt(marker, frames, f"leaps by {leap:.3g} m, and the body is {size:.3g} m across,")
    return Doubt(marker, frames, f"is suddenly {leap:.3g} m away, and then back,", LABEL)


def _moved(recording: Recording, marker: int, track: Track, step: int, size: float, begin: int) -> Doubt:
    """Return what is wrong with a marker that moves suddenly and stays; refuse what no body does."""
    before, after = track.frames[step], track.frames[step + 1]
    when = f"between frames {begin + before} and {begin + after} ({recording.time[after]:.6g} s)"
    name, leap = recording.names[marker], track.leaps[step]
    other = _place_of(recording, marker, track, step)
    if other is not None:
        to = recording.positions[after, other]
        if np.linalg.norm(to - track.x[step]) <= SAME * leap:
            raise DataError(
                f"{recording.source}: markers '{name}' and '{recording.names[other]}' exchange their places {when}: "
                "correct their labels in the recording"
            )
    if leap > size:
        raise DataError(
            f"{recording.source}: marker '{name}' leaps by {leap:.3g} m {when} and stays there, and the body is "
            f"{size:.3g} m across: correct its label in the recording, or leave it out of `markers:`"
        )
    what = f"moves suddenly by {leap:.3g} m, and not before and after,"
    return Doubt(marker, track.frames[step : step + 2], what, LABEL)


def _place_of(recording: Recording, marker: int, track: Track, step: int) -> int | None:
    """Return the marker that was, before a step, where this one is after it; None if there is none."""
    before = np.linalg.norm(recording.positions[track.frames[step]] - track.x[step + 1], axis=1)
    near = [m for m in range(len(before)) if m != marker and before[m] <= SAME * track.leaps[step]]
    return min(near, key=lambda m: before[m]) if near else None

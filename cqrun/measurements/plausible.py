"""Measurements that no body could make: gaps written as zeros, leaps, exchanged labels, held positions, other units.

A marker on a body moves little from one frame to the next. Camera systems make sudden errors: they lose a marker and
write zeros or its last position, or take one marker for another. Frames that are certainly wrong are taken as not seen,
what cannot be mended so is refused, and what is only odd is reported. Nothing else is changed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from cqrun.errors import DataError
from cqrun.explain import listed
from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array

SUDDEN, NEAR = 10.0, 5
"""A step is sudden if it is so many times as long as the median of its neighbours, so many before and behind."""

SMALL, SMALLEST = 0.05, 0.01
"""Steps that are reported are longer than this part of the body; and those from and to a position that is held."""

ZERO = 3.0
"""A marker that moves to 0 by so many times as much as it moves else is not seen there."""

SAME = 0.25
"""Two places are the same if they are nearer than this part of the leap between them and a third."""

HELD = 5
"""So many frames in which a marker does not move at all, while others do, are held and not measured."""

LABEL = "is its label right there?"

SLACK = 1e-6
"""Of the span, in frames."""

UNIT = 0.02
"""Largest difference of a ratio from a power of ten, in decades, where a unit changes."""


class Doubt(NamedTuple):
    """Something wrong with a marker: its frames, what is wrong, and what a user should ask of frames that are used."""

    marker: int
    frames: Array
    what: str
    question: str = ""

    @property
    def unseen(self) -> bool:
        """Whether the marker is taken as not seen in these frames."""
        return not self.question


@dataclass(frozen=True)
class Track:
    """One marker where it was seen.

    Attributes:
        frames: (n,) in the recording.
        x: (n, D) [m].
    """

    frames: Array
    x: Array

    @cached_property
    def leaps(self) -> Array:
        """Distance from each position to the next (n - 1,) [m]."""
        return np.linalg.norm(np.diff(self.x, axis=0), axis=1)

    @cached_property
    def steps(self) -> Array:
        """The same for one frame, where frames between were not seen (n - 1,) [m]."""
        return np.asarray(self.leaps / np.diff(self.frames))

    @cached_property
    def usual(self) -> Array:
        """Median of the steps around each (n - 1,) [m]."""
        return np.median(sliding_window_view(np.pad(self.steps, NEAR, mode="edge"), 2 * NEAR + 1), axis=1)

    def alone(self, first: int, last: int) -> bool:
        """Say whether the motion before the step `first` and after the step `last` is slow beside these steps."""
        before = self.steps[first - 1] if first > 0 else 0.0
        after = self.steps[last + 1] if last + 1 < len(self.steps) else 0.0
        return bool(before <= SAME * self.steps[first] and after <= SAME * self.steps[last])


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
    doubts = list(_zeros(part, reach))
    _take_out(part, doubts)
    size = max(reach, _extent(part))
    _refuse_other_units(part, size, begin)
    held = list(_held(part, size))
    _take_out(part, held)
    doubts += held
    doubts += _leaps(part, size, begin)
    _take_out(part, doubts)
    positions = recording.positions.copy()
    positions[begin:end] = part.positions
    sentences = tuple(_sentence(doubt, recording, begin) for doubt in doubts)
    return replace(recording, positions=positions), sentences


def track_of(recording: Recording, marker: int) -> Track:
    """Return a marker where it was seen."""
    frames = np.flatnonzero(recording.seen()[:, marker])
    return Track(frames, recording.positions[frames, marker])


def _take_out(recording: Recording, doubts: list[Doubt]) -> None:
    for doubt in doubts:
        if doubt.unseen:
            recording.positions[doubt.frames, doubt.marker] = np.nan


def _extent(recording: Recording) -> float:
    """Return how far apart the markers are [m], in whatever unit the recording is."""
    seen = recording.seen().any(axis=0)
    if not seen.any():
        return 0.0
    return float(np.linalg.norm(np.ptp(np.nanmedian(recording.positions[:, seen], axis=0), axis=0)))


# --- gaps that are written as positions -------------------------------------------------------------------------------


def _zeros(recording: Recording, reach: float) -> Iterator[Doubt]:
    """Yield the frames in which a marker is at exactly 0, unless it moves there as it moves elsewhere."""
    for marker in range(len(recording.names)):
        track = track_of(recording, marker)
        zero = (track.x == 0).all(axis=1)
        if not zero.any() or zero.all():
            continue
        edges = np.flatnonzero(zero[1:] != zero[:-1])
        others = track.steps[~zero[1:] & ~zero[:-1]]
        least = ZERO * float(np.quantile(others, 0.9)) if others.size >= HELD else reach
        frames = [
            track.frames[run]
            for run in np.split(np.arange(len(zero)), edges + 1)
            if zero[run[0]] and all(track.leaps[k] > least for k in edges if k + 1 in (run[0], run[-1] + 1))
        ]
        if frames:
            yield Doubt(marker, np.concatenate(frames), "is at exactly 0")


def _held(recording: Recording, size: float) -> Iterator[Doubt]:
    """Yield the frames in which a marker has exactly its last position, while others move."""
    changes = [_changes(recording, marker) for marker in range(len(recording.names))]
    for marker in range(len(recording.names)):
        track = track_of(recording, marker)
        if len(track.x) <= HELD:
            continue
        others = [change for m, change in enumerate(changes) if m != marker]
        if not track.leaps.any():
            if any(np.nansum(change) > 0 and np.nanmin(change) > 0 for change in others):
                yield Doubt(marker, track.frames, "never moves at all, and others do,", "was it seen?")
            continue
        runs = _runs(track)
        long = [(first, last) for first, last in runs if last - first + 1 >= HELD]
        frames = [
            track.frames[first + 1 : last + 1]
            for first, last in long
            if _is_held(track, first, last, size, others, repeats=len(long) < len(runs))
        ]
        if frames:
            yield Doubt(marker, np.concatenate(frames), "keeps exactly one place, while others move,")


def _runs(track: Track) -> list[tuple[int, int]]:
    """Return the first and the last of positions that follow each other and are exactly the same."""
    same = np.r_[False, (track.leaps == 0) & (np.diff(track.frames) == 1), False]
    begins, ends = np.flatnonzero(same[1:] & ~same[:-1]), np.flatnonzero(~same[1:] & same[:-1])
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


def _changes(recording: Recording, marker: int) -> Array:
    """Return how far a marker moves from each frame to the next (T - 1,), NaN where it was not seen [m]."""
    return np.linalg.norm(np.diff(recording.positions[:, marker], axis=0), axis=1)


def _is_held(track: Track, first: int, last: int, size: float, others: list[Array], *, repeats: bool) -> bool:
    """Say whether a marker does not move from `first` to `last` as no body does: others move, and it did itself.

    Args:
        repeats: whether it has the same position in a few frames elsewhere, as rounded positions have.
    """
    inside = slice(track.frames[first], track.frames[last])
    paths = [float(np.nansum(change[inside])) for change in others if np.nanmin(change[inside], initial=np.inf) > 0]
    farthest = max(paths, default=0.0)
    if first > 0 and not repeats and farthest > SMALLEST * size:
        return True
    steps = np.abs(np.diff(track.x, axis=0))
    least = max(SUDDEN * float(steps[steps > 0].min()), SMALLEST * size)  # a rounded position moves by its last digit
    into = track.steps[first - 1] if first > 0 else 0.0
    out = track.steps[last] if last < len(track.steps) else 0.0
    after = track.steps[last + 1] if last + 1 < len(track.steps) else 0.0
    starts = out > least and out > ZERO * after and farthest > 0
    return bool(starts or (into > least and farthest > ZERO * into))


# --- leaps ------------------------------------------------------------------------------------------------------------


def _refuse_other_units(recording: Recording, size: float, begin: int) -> None:
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


def _leaps(recording: Recording, size: float, begin: int) -> Iterator[Doubt]:
    """Yield the sudden motions of every marker; refuse those that cannot be mended."""
    for marker in range(len(recording.names)):
        track = track_of(recording, marker)
        if len(track.x) <= HELD:
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


# --- words ------------------------------------------------------------------------------------------------------------


def _sentence(doubt: Doubt, recording: Recording, begin: int) -> str:
    frames = doubt.frames + begin
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    ranges = listed((f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs), 6)
    times = " to ".join(f"{recording.time[k]:.6g}" for k in dict.fromkeys((frames[0], frames[-1])))
    when = f"in frame{'s' * (len(frames) > 1)} {ranges} ({times} s)"
    what = f"marker '{recording.names[doubt.marker]}' {doubt.what} {when}"
    return f"{what}: taken as not seen" if doubt.unseen else f"{what}: {doubt.question}"

"""Gaps that are written as positions: exact zeros, the last position again, or the position of another marker."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cqrun.measurements.recording import Recording
from cqrun.measurements.track import LABEL, Doubt, Track, track_of
from cqrun.plugin.contract import Array

SUDDEN, SMALLEST = 10.0, 0.01
"""A long step leads to or from a position that is held: so many times as long as the marker's smallest step, and longer
than this part of the body."""

ZERO = 3.0
"""A marker is not seen at 0 if the step to it is so many times as long as the marker's other steps."""

HELD = 5
"""If a marker does not move at all in so many frames, while others do, its position is held and not measured."""


def zeros(recording: Recording, reach: float) -> Iterator[Doubt]:
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


def held(recording: Recording, size: float) -> Iterator[Doubt]:
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


def stopped(recording: Recording, size: float) -> Iterator[Doubt]:
    """Yield the frames in which no marker moves at all, as measured markers never do.

    A model can stand still, at the beginning or under a load that grows in steps. So a recording is only reported if no
    marker stands still for long elsewhere, or if several move until the frames begin, and again when they end. Rounded
    positions may be equal by chance in a few frames.
    """
    moves = np.stack([_changes(recording, marker) for marker in range(len(recording.names))], axis=1)
    still = (moves == 0).any(axis=1) & ~(moves > 0).any(axis=1)
    fast = (moves > SMALLEST * size).sum(axis=1) >= 2  # NaN is not
    for first, last in np.flatnonzero(np.diff(np.r_[False, still, False])).reshape(-1, 2).tolist():
        goes_on = last < len(moves)
        changes_always = not any(_longest(column == 0, first, last) >= HELD for column in moves.T)
        moving = first > 1 and fast[first - 2 : first].all() and fast[last : last + 2].all()
        if first > 0 and last - first >= HELD and (changes_always or moving):
            what = "moves at all, although they move before" + " and after" * goes_on + ","
            yield Doubt(None, np.arange(first + 1, last + 1), what, "did the recording stop there?")


def _longest(same: Array, first: int, last: int) -> int:
    """Return how often `same` (n,) is true in a row, before `first` or from `last` on."""
    edges = np.flatnonzero(np.diff(np.r_[False, same[:first], False, same[last:], False])).reshape(-1, 2)
    return int(np.diff(edges).max(initial=0))


def coincident(recording: Recording) -> Iterator[Doubt]:
    """Yield the frames in which a marker is exactly where another one is."""
    x = recording.positions
    for marker, name in enumerate(recording.names):
        same = (x[:, marker + 1 :] == x[:, marker : marker + 1]).all(axis=2)  # NaN is not
        for other in np.flatnonzero(same.any(axis=0)):
            yield Doubt(marker + 1 + int(other), np.flatnonzero(same[:, other]), f"is exactly where '{name}' is", LABEL)

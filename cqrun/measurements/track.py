"""The track of one marker where it was seen, and what can be wrong with it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from cqrun.explain import listed
from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array

NEAR = 5
"""The usual step is the median of so many steps before and behind."""

SAME = 0.25
"""Two places are the same if they are nearer than this part of the leap between them and a third."""

LABEL = "is its label right there?"


class Doubt(NamedTuple):
    """Something wrong with a marker, or with all markers.

    Attributes:
        marker: its index; None means all markers.
        frames: where it is wrong.
        what: what is wrong, as a predicate.
        question: what a user should ask about frames that are used; empty if they are taken as not seen.
    """

    marker: int | None
    frames: Array
    what: str
    question: str = ""

    def sentence(self, recording: Recording, begin: int) -> str:
        """Return what is wrong, when, and what is done about it; `frames` are counted from frame `begin`."""
        frames = self.frames + begin
        runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
        ranges = listed((f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs), 6)
        times = " to ".join(f"{recording.time[k]:.6g}" for k in dict.fromkeys((frames[0], frames[-1])))
        who = "no marker" if self.marker is None else f"marker '{recording.names[self.marker]}'"
        when = f"in frame{'s' * (len(frames) > 1)} {ranges} ({times} s)"
        return f"{who} {self.what} {when}: {self.question or 'taken as not seen'}"


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


def track_of(recording: Recording, marker: int) -> Track:
    """Return a marker where it was seen."""
    frames = np.flatnonzero(recording.seen()[:, marker])
    return Track(frames, recording.positions[frames, marker])


def take_out(recording: Recording, doubts: Iterable[Doubt]) -> list[Doubt]:
    """Write NaN for the positions that are taken as not seen, and return all doubts."""
    doubts = list(doubts)
    for doubt in doubts:
        if not doubt.question:
            recording.positions[doubt.frames, doubt.marker] = np.nan
    return doubts

"""What a recording of markers shows before anything is known of the body: rest, start, rhythm, where it is held.

A scene that is proposed for the recording begins from this (proposal.py). Nothing here is exact: some of the frames and
markers, and thresholds that are parts of the largest motion, are good enough for a first guess.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cqrun.characters import printable
from cqrun.errors import DataError
from cqrun.explain import listed
from cqrun.measurements.plausible import plausible
from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array

FRAMES = 4000
"""So many frames are looked at; of more, a part that is spread evenly."""

SEEN = 0.5
"""A marker that is seen in a smaller part of the frames is left out."""

WINDOW = 0.05, 5
"""Length of the window in which a marker may be at rest [s], and the smallest number of its frames."""

CALM = 0.01
"""A marker is at rest if it moves less than this part of the largest motion, or than twice in the calmest window."""

EARLY, FEW = 0.06, 4
"""Part of a period after which a body that is let go has no constant acceleration any more, and frames to fit it in."""

BRIEFEST = 0.1, 0.3
"""A rest is longer than this [s], and than this part of the period: a body that turns around is not at rest."""

HARDLY = 0.05
"""A marker that moves less than this part of the one that moves most is where the body is held."""

RHYTHM = 1.5, 4.0
"""A rhythm has so many periods in the motion, and so many times the mean strength of all frequencies."""


@dataclass(frozen=True)
class Seen:
    """What a recording shows.

    Attributes:
        time: (T,) [s], and `positions` (T, M, D) of the chosen markers [m], NaN where one was not seen.
        names: of the chosen markers (M,).
        left_out: markers that are not used, with the reason.
        rests: begin and end of all intervals in which no marker moves [s].
        still: the one of them after which the motion begins, or None.
        start: when the motion begins [s]; the first frame if no rest comes before it.
        rest: (M, D) place of each marker in the still frames, or when it is seen first [m].
        moved: (M,) root mean square displacement of each marker after the start [m].
        drift: (D,) mean displacement of the markers that move, at the end of the motion [m].
        period: of the strongest rhythm in the motion [s], or None.
    """

    time: Array
    positions: Array
    names: tuple[str, ...]
    left_out: tuple[str, ...]
    rests: tuple[tuple[float, float], ...]
    still: tuple[float, float] | None
    start: float
    rest: Array
    moved: Array
    drift: Array
    period: float | None

    @property
    def held(self) -> Array:
        """Which markers hardly move: (M,) bool."""
        return np.asarray(self.moved < HARDLY * self.moved.max())

    @property
    def frame(self) -> float:
        """Time between two frames [s]."""
        return float(np.median(np.diff(self.time)))

    def turned(self, rotation: Array) -> Seen:
        """Return the same in other axes: (D, D) maps the axes of the recording to them."""
        turned = {name: getattr(self, name) @ rotation.T for name in ("positions", "rest", "drift")}
        return replace(self, **turned)


def look(recording: Recording, most: int = 12, fewest: int = 2) -> Seen:
    """Return what a recording shows, in at most so many of its markers.

    Raises:
        DataError: fewer markers than needed can be used, or nothing moves.
    """
    recording, _ = plausible(recording, np.inf, (-np.inf, np.inf))
    recording, left_out = _chosen(recording, most, fewest)
    step = -(-len(recording.time) // FRAMES)
    time, x = recording.time[::step], recording.positions[::step]
    reach = float(np.max(_travel(x)))
    period = _period(time, x)
    calm = _calm(time, x, reach, recording.source)
    rests = _intervals(time, calm, max(BRIEFEST[0], BRIEFEST[1] * (period or 0.0)))
    still = next((rest for rest in rests if rest[1] < time[-1]), None)
    rest = _rest_places(time, x, still, period)
    still, start = (None, float(time[0])) if still is None else _begin(time, x - rest, still, reach)
    after = time >= start
    moved = np.sqrt(_mean(np.sum((x - rest)[after] ** 2, axis=2)))
    moving = moved >= HARDLY * moved.max()
    final = [r for r in rests if r[0] > start]
    last = time >= (final[-1][0] if final else time[-1] - (time[-1] - start) / 3)
    drift = _mean((x - rest)[last][:, moving]).mean(axis=0)
    return Seen(
        time, x, recording.names, left_out, tuple(rests), still, start, rest, moved, np.nan_to_num(drift), period
    )


# --- markers ----------------------------------------------------------------------------------------------------


def _chosen(recording: Recording, most: int, fewest: int) -> tuple[Recording, tuple[str, ...]]:
    """Return a recording of the markers that can be used, and the others with the reasons."""
    names, share = recording.names, recording.seen().mean(axis=0)
    reasons = {
        "another has the same name": [k for k, name in enumerate(names) if names.count(name) > 1],
        "its name cannot be written": [
            k for k, name in enumerate(names) if not name.strip() or printable(name) != name
        ],
        "it is rarely seen": np.flatnonzero(share < SEEN).tolist(),
    }
    out = dict.fromkeys(k for bad in reasons.values() for k in bad)
    usable = [k for k in range(len(names)) if k not in out]
    if len(usable) < fewest:
        way_out = "; or give the edges of the body with --size" if usable else ""
        raise DataError(
            f"{recording.source}: {len(usable)} of its {len(names)} markers can be used, and a body cannot be guessed "
            f"from fewer than {fewest}: a marker needs a name of its own, and to be seen in half of the frames{way_out}"
        )
    kept = _spread([float(share[k]) for k in usable], recording.positions[:, usable], usable, most)
    left_out = [f"{printable(names[k])} ({why})" for why, bad in reasons.items() for k in bad]
    if len(kept) < len(usable):
        left_out.append(f"{len(usable) - len(kept)} others (a scene has room for {most})")
    chosen = replace(recording, names=tuple(names[k] for k in kept), positions=recording.positions[:, kept])
    return chosen, tuple(dict.fromkeys(left_out))


def _spread(share: list[float], x: Array, markers: list[int], most: int) -> list[int]:
    """Return at most so many of the markers that are far apart, in their order; x (T, M, D) are their positions."""
    if len(markers) <= most:
        return markers
    places = np.nan_to_num(_mean(x))
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < most:
        chosen.append(int(np.argmax(distance * share)))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return [markers[k] for k in sorted(chosen)]


# --- rest and motion --------------------------------------------------------------------------------------------


def _mean(x: Array) -> Array:
    """Return the mean over frames, of what was seen; NaN if nothing was."""
    seen = ~np.isnan(x)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(seen, x, 0.0).sum(axis=0) / seen.sum(axis=0))


def _travel(x: Array) -> Array:
    """Return how far each marker gets within frames (..., T, M, D) [m]: the diagonal of the box around its path."""
    least, most = np.where(np.isnan(x), np.inf, x).min(axis=-3), np.where(np.isnan(x), -np.inf, x).max(axis=-3)
    return np.asarray(np.linalg.norm(np.maximum(most - least, 0.0), axis=-1))


def _calm(time: Array, x: Array, reach: float, source: str) -> Array:
    """Return in which frames no marker moves (T,) bool."""
    width = int(min(max(WINDOW[1], round(WINDOW[0] / float(np.median(np.diff(time))))), max(2, len(time) // 4)))
    travel = np.array([_travel(x[k : k + width]).max() for k in range(len(time) - width + 1)])
    quietest = float(travel.min())
    if not reach > 3.0 * quietest or not np.isfinite(reach):
        raise DataError(
            f"{source}: no marker moves by more than {1e3 * reach:.2g} mm, which is no more than the noise: nothing "
            "can be fitted to it"
        )
    calm = np.zeros(len(time), bool)
    for k in np.flatnonzero(travel <= max(2.0 * quietest, CALM * reach)):
        calm[k : k + width] = True
    return calm


def _intervals(time: Array, calm: Array, shortest: float) -> list[tuple[float, float]]:
    """Return begin and end of the runs of calm frames that last long enough [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], calm, [False]]).astype(int)))
    runs = [(float(time[a]), float(time[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if run[1] - run[0] >= shortest]


def _rest_places(time: Array, x: Array, still: tuple[float, float] | None, period: float | None) -> Array:
    """Return where each marker is at rest (M, D) [m]: in the still frames, or else at the first one.

    A body that is let go has moved by a t^2 / 2 after a time t, so x = rest + b t^2 fits the first frames, and a single
    frame's noise counts less.
    """
    places = np.full(x.shape[1:], np.nan)
    early = time - time[0] <= EARLY * (period or 0.0)
    if still is not None:
        places = _mean(x[(time >= still[0]) & (time <= still[1])])
    elif early.sum() >= FEW and not np.isnan(x[early]).any():
        squares = (time[early] - time[0]) ** 2
        basis = np.stack([np.ones(len(squares)), squares], axis=1)
        places = np.linalg.lstsq(basis, x[early].reshape(len(basis), -1), rcond=None)[0][0].reshape(x.shape[1:])
    first = np.argmax(~np.isnan(x[..., 0]), axis=0)
    return np.where(np.isnan(places), x[first, np.arange(x.shape[1])], places)


def _begin(
    time: Array, away: Array, still: tuple[float, float], reach: float
) -> tuple[tuple[float, float] | None, float]:
    """Return the still frames without the last ones, and when the motion begins [s].

    A body that is let go has moved by a t^2 / 2 after a time t. So it is four times as far after twice the time.

    Args:
        away: displacements from rest (T, M, D) [m].
        reach: the largest motion [m].
    """
    distance = np.nan_to_num(np.linalg.norm(away, axis=2)).max(axis=1)
    inside = (time >= still[0]) & (time <= still[1])
    first = max(2.0 * float(np.quantile(distance[inside], 0.9)), CALM * reach)
    middle = still[0] + 0.5 * (still[1] - still[0])
    late = np.where(time > middle, distance, 0.0)
    passed = [_crossing(time, late, level) for level in (first, 4.0 * first) if late.max() > level]
    at = passed[0] if passed else still[1]
    start = float(np.clip(2.0 * at - passed[1], middle, at)) if len(passed) == 2 else at
    end = min(still[1], start) - 0.05 * (still[1] - still[0])
    return (still[0], end), start


def _crossing(time: Array, distance: Array, level: float) -> float:
    """Return when a distance (T,) first passes a level that it passes somewhere [s], between two frames."""
    k = int(np.argmax(distance > level))
    low, high = distance[max(k - 1, 0)], distance[k]
    return float(time[k] - (high - level) / (high - low) * (time[k] - time[max(k - 1, 0)]) if high > low else time[k])


def _period(time: Array, x: Array) -> float | None:
    """Return the period of the strongest rhythm in what moves most [s], or None if there is none."""
    seen = np.where(np.isnan(x), np.nanmean(x, axis=0) if np.isfinite(x).any() else 0.0, x).reshape(len(x), -1)
    track = seen[:, int(np.argmax(np.std(seen, axis=0)))]
    even = np.linspace(time[0], time[-1], len(time))
    velocity = np.diff(np.interp(even, time, track))  # of the velocity, in which a sag is a single peak
    strength = np.abs(np.fft.rfft(velocity * np.hanning(len(velocity)))) ** 2
    frequency = np.fft.rfftfreq(len(velocity), float(even[1] - even[0]))
    k = 1 + int(np.argmax(strength[1:])) if len(strength) > 2 else 0
    if k == 0 or frequency[k] * (time[-1] - time[0]) < RHYTHM[0] or strength[k] < RHYTHM[1] * strength[1:].mean():
        return None
    return float(1.0 / frequency[k])


def names_of(seen: Seen, which: Array, most: int = 4) -> str:
    """Return the names of some markers as text."""
    return listed([name for name, chosen in zip(seen.names, which, strict=True) if chosen], most)

"""Transform a recording from its own axes to the scene's, and compute displacements from the still frames.

A rigid transform maps the mean of the frames before the release to the rest positions of the markers (Kabsch). It does
not stretch, so its residuals show how accurately the rest positions are known. Because of these residuals,
displacements of each marker from its own mean are compared, and not positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array

LARGEST_RESIDUAL = 5e-3
"""Largest allowed distance of a marker from its rest position after alignment [m]."""

LARGEST_SHARE = 0.05
"""The same limit as a part of the markers' extent, because on a small body even swapped names give small residuals."""

_THINNEST = 0.02
"""Markers are collinear if their second extent is less than this part of the first."""

_LOOKS = {
    3: "is in millimetres: say `units: mm`",
    2: "is in centimetres: say `units: cm`",
    1: "is in millimetres, not centimetres: correct `units:`",
    -1: "is in centimetres, not millimetres: correct `units:`",
    -2: "is in metres, not centimetres: correct `units:`",
    -3: "is in metres, not millimetres: correct `units:`",
}
"""Advice about the units, by the power of ten in the ratio of extents."""


@dataclass(frozen=True)
class Alignment:
    """Rigid transform scene = rotation @ recording + translation.

    Attributes:
        rotation: rotation matrix (D, D).
        translation: (D,) [m].
        residuals: distance of each marker's mean still position from its rest position (M,) [m].
    """

    rotation: Array
    translation: Array
    residuals: Array

    def __str__(self) -> str:
        least, most = 1e3 * self.residuals.min(), 1e3 * self.residuals.max()
        return f"aligned to the rest positions within {least:.2f} to {most:.2f} mm"


@dataclass(frozen=True)
class Measured:
    """A recording in the scene's frame, ready to be compared with a model.

    Attributes:
        time: the time in the recording (T,) [s].
        names: names of the M markers.
        rest: rest positions in the scene's frame (M, D) [m].
        values: displacements from the still mean, or positions if `absolute` (T, M, D) [m]; NaN where a marker was not
            seen.
        still: displacements in the still frames (T_s, M, D) [m]; NaN where not seen; T_s = 0 without still frames.
        absolute: whether `values` are positions in the scene's frame.
        alignment: None if the recording was already in the scene's frame.
        source: name of the recording in error messages.
    """

    time: Array
    names: tuple[str, ...]
    rest: Array
    values: Array
    still: Array
    absolute: bool
    alignment: Alignment | None
    source: str


def measure(recording: Recording, markers: Mapping[str, Array], still: tuple[float, float] | None) -> Measured:
    """Bring the named markers of a recording into the scene's frame.

    Args:
        recording: the recording.
        markers: rest position (D,) of each marker in the scene's frame [m].
        still: first and last time of the frames at rest before the release [s]; None if the recording is already in
            the scene's frame, like cqrun's own recordings.

    Raises:
        DataError: no markers, unknown or repeated markers, another dimension, no still frames, a marker that is never
            seen in them, fewer than 3 or collinear markers, wrong units, or a residual that is too large.
    """
    chosen = recording.select(list(markers))
    rest = np.array([np.asarray(x, dtype=float) for x in markers.values()]).reshape(len(markers), -1)
    if rest.shape[1] != chosen.dim:
        raise DataError(f"{chosen.source}: the recording is {chosen.dim}D and the scene {rest.shape[1]}D")
    _check_seen(chosen)
    if still is None:
        _check_not_zero(chosen, rest)
        return Measured(
            chosen.time, chosen.names, rest, chosen.positions, np.zeros((0, *rest.shape)), True, None, chosen.source
        )
    frames, mean = still_frames(chosen, still), still_mean(chosen, still)
    try:
        alignment = align(mean, rest, chosen.names, chosen.source)
    except DataError as error:
        zero = [f"marker '{name}' is at exactly 0" for name, x in zip(chosen.names, mean, strict=True) if not x.any()]
        unseen = f"; {' and '.join(zero)}: if it was not seen, leave it out of `markers:`" if zero else ""
        raise DataError(f"{error}{unseen}") from None
    values = (chosen.positions - mean) @ alignment.rotation.T
    return Measured(chosen.time, chosen.names, rest, values, values[frames], False, alignment, chosen.source)


def still_frames(recording: Recording, still: tuple[float, float]) -> Array:
    """Return which frames have still[0] <= time <= still[1]: (T,) of bool."""
    first, last = still
    begin, end = recording.time[0], recording.time[-1]
    slack = 1e-6 * (end - begin) / (recording.time.size - 1)
    if not begin - slack <= first < last <= end + slack:
        raise DataError(
            f"{recording.source}: the still frames, {first:g} to {last:g} s, do not lie "
            f"inside the recording, {begin:g} to {end:g} s"
        )
    return np.asarray((recording.time >= first - slack) & (recording.time <= last + slack))


def still_mean(recording: Recording, still: tuple[float, float]) -> Array:
    """Return each marker's mean position (M, D) over the frames with still[0] <= time <= still[1] [m]."""
    frames = still_frames(recording, still)
    seen = recording.seen()[frames]
    for name, count in zip(recording.names, seen.sum(axis=0), strict=True):
        if count == 0:
            raise DataError(
                f"{recording.source}: marker '{name}' is not seen in any still frame, {still[0]:g} "
                f"to {still[1]:g} s; choose other still frames or leave the marker out"
            )
    shown = np.where(seen[..., None], recording.positions[frames], 0.0)
    return np.asarray(shown.sum(axis=0) / seen.sum(axis=0)[:, None])


def align(mean: Array, rest: Array, names: tuple[str, ...], source: str = "") -> Alignment:
    """Return the rigid transform that maps `mean` to `rest`, both (M, D), in the least-squares sense.

    In 2D the rotation stays in the plane, so that a mirror image is never accepted as a rotation.

    Raises:
        DataError: fewer than 3 markers (2D: 2), collinear markers, wrong units, or a residual above the smaller of
            LARGEST_RESIDUAL and LARGEST_SHARE times the markers' extent.
    """
    dim = rest.shape[1]
    if len(rest) < dim:
        raise DataError(f"{source}: {len(rest)} alignment markers; a rigid alignment in {dim}D needs {dim} or more")
    for points, which in ((rest, "the rest positions of the markers"), (mean, "the recorded markers")):
        _check_spread(points, which, source)
    _check_units(mean, rest, source)
    rotation = _rotation(mean - mean.mean(axis=0), rest - rest.mean(axis=0))
    translation = rest.mean(axis=0) - rotation @ mean.mean(axis=0)
    residuals = np.linalg.norm(mean @ rotation.T + translation - rest, axis=1)
    share = LARGEST_SHARE * float(np.linalg.norm(np.ptp(rest, axis=0)))
    largest = min(LARGEST_RESIDUAL, share)
    if residuals.max() > largest:
        listed = ", ".join(f"'{n}' {1e3 * r:.2f}" for n, r in zip(names, residuals, strict=True))
        why = f", {LARGEST_SHARE:.0%} of the markers' extent," if share < LARGEST_RESIDUAL else ""
        raise DataError(
            f"{source}: after alignment a marker is {1e3 * residuals.max():.2g} mm from its rest position, "
            f"more than {1e3 * largest:.2g} mm{why} (all, mm: {listed}); check the rest positions in "
            "`markers:`, whether two names are swapped, and that `still:` ends before the release"
        )
    return Alignment(rotation, translation, residuals)


def _rotation(recorded: Array, rest: Array) -> Array:
    """Return the best rotation of centred points (M, D)."""
    from scipy.spatial.transform import Rotation

    dim = rest.shape[1]
    if dim == 3:
        return np.asarray(Rotation.align_vectors(rest, recorded)[0].as_matrix())
    flat = [np.vstack([[0.0, 0.0, 1.0], np.pad(points, ((0, 0), (0, 1)))]) for points in (rest, recorded)]
    axis_first = np.r_[np.inf, np.ones(len(rest))]
    return np.asarray(Rotation.align_vectors(*flat, weights=axis_first)[0].as_matrix()[:2, :2])


def _check_seen(recording: Recording) -> None:
    for marker, name in enumerate(recording.names):
        if not recording.seen()[:, marker].any():
            raise DataError(f"{recording.source}: marker '{name}' is NaN in every frame; leave it out of `markers:`")


def _check_not_zero(recording: Recording, rest: Array) -> None:
    """Refuse markers that are nowhere but at 0; with still frames they are named if the alignment fails."""
    for name, track, place in zip(recording.names, recording.positions.transpose(1, 0, 2), rest, strict=True):
        if place.any() and not np.nan_to_num(track).any():
            raise DataError(
                f"{recording.source}: marker '{name}' is at exactly 0 in every frame: it was not seen; leave it out of "
                "`markers:`"
            )


def _check_spread(points: Array, which: str, source: str) -> None:
    """Refuse points that do not determine the rotation: on one line in 3D, or all at one place in 2D."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[0] == 0:
        raise DataError(f"{source}: {which} are all at one place; the alignment needs them apart")
    if points.shape[1] == 3 and extents[1] < _THINNEST * extents[0]:
        raise DataError(
            f"{source}: {which} lie on one line, so the rotation about it is unknown; use 3 or more that do not"
        )


def _check_units(mean: Array, rest: Array, source: str) -> None:
    """Refuse a recording whose extent differs from the body's by a factor of about 10, 100 or 1000."""
    spread = [float(np.sqrt(np.var(points, axis=0).sum())) for points in (mean, rest)]
    power = float(np.log10(spread[0] / spread[1]))
    if round(power) in _LOOKS and abs(power - round(power)) < 0.3:
        raise DataError(
            f"{source}: the recorded markers are {10**power:.3g} times as far apart as their rest "
            f"positions; it looks as if the recording {_LOOKS[round(power)]}"
        )

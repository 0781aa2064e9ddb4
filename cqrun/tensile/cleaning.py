"""Take from a curve what is not the first loading of one specimen, and say so; refuse what cannot be one."""

from __future__ import annotations

import numpy as np

from cqrun.errors import DataError
from cqrun.plugin.contract import Array
from cqrun.tensile.columns import OPTICAL
from cqrun.tensile.curve import Curve, Given
from cqrun.tensile.failure import without_failure, without_glitches
from cqrun.tensile.slack import LARGEST, SMALLEST, find_slack

FEWEST = 3
"""A curve has at least so many points."""

RESTART, RESTARTED = 0.3, 0.2
"""The strain starts again if it falls by the first part of its largest value in one line, to below the second."""

BACK = 0.005
"""Strain that falls by this part of its range is unloading, and less is noise."""


def clean(curve: Curve, given: Given) -> Curve:
    """Return the first loading of a curve, with a remark on everything that was removed.

    Raises:
        DataError: too few points, two tests in one file, or signs that contradict each other.
    """
    curve = without_gaps(curve, np.isfinite(curve.stretch) & np.isfinite(curve.stress))
    require_points(curve)
    require_one_test(curve)
    _require_signs(curve)
    curve = _first_loading(curve, given)
    if given.unloading == "cut":
        curve = without_failure(without_glitches(curve))
    curve = _taut(curve, given)
    if given.span is not None:
        low, high = given.span
        strain = curve.stretch - 1.0
        kept = (strain >= low) & (strain <= high)
        curve = curve.at(kept, f"strain from {low:g} to {high:g} alone: {kept.sum()} of {len(kept)} points")
    require_points(curve)
    return curve


def without_gaps(curve: Curve, seen: Array) -> Curve:
    """Return the points of a curve that were seen (n,), with a remark on the others."""
    gaps = int((~seen).sum())
    if not gaps:
        return curve
    lines = "line" if gaps == 1 else "lines"
    return curve.at(seen, f"{gaps} {lines} without numbers removed (first: {curve.source}:{curve.line[~seen][0]})")


def require_points(curve: Curve) -> None:
    """Raise a DataError if a curve has too few points."""
    n = len(curve.stretch)
    if n < FEWEST or np.ptp(curve.stretch) == 0.0:
        points = {0: "no point", 1: "one point"}.get(n, f"{n} points")
        where = " at one strain" if n >= FEWEST else ""
        raise DataError(
            f"{curve.source}: the {curve.mode} test has {points}{where} that can be used; a curve needs at least "
            f"{FEWEST}, at different strains"
        )


def require_one_test(curve: Curve) -> None:
    """Raise a DataError if the strain of a curve starts again: it has two specimens."""
    extent = np.abs(curve.stretch - 1.0)
    falls = extent[:-1] - extent[1:]
    usual = float(np.median(np.abs(falls)))
    largest = np.maximum.accumulate(extent)[:-1]
    again = (falls > max(10.0 * usual, RESTART * extent.max())) & (extent[1:] < RESTARTED * largest)
    if again.any():
        line = curve.line[1:][again][0]
        raise DataError(
            f"{curve.source}:{line}: the strain starts again here: two materials or specimens in one file? Write each "
            "to a file of its own; give several specimens of one material together"
        )


def _require_signs(curve: Curve) -> None:
    strain = curve.stretch - 1.0
    if not curve.stress.any():
        raise DataError(
            f"{curve.source}: the stress is zero at all points: a test has a stress that grows; is it the right "
            "column? --column stress=N says which one it is"
        )
    if float(strain @ curve.stress) < 0.0:
        pulled = float(strain.sum()) > 0.0
        signs = ("negative", "positive") if pulled else ("positive", "negative")
        raise DataError(
            f"{curve.source}: the stress is {signs[0]} where the strain is {signs[1]}: tension has two positive "
            "numbers, compression two negative ones. If this is a compression test, give --compression"
        )


def _first_loading(curve: Curve, given: Given) -> Curve:
    """Return the points at strains that the specimen had not reached before; all points if the strain only grows."""
    strain = curve.stretch - 1.0
    if given.unloading == "keep":
        return curve.at(slice(None), "unloading is kept")
    if _monotonic(strain):
        return curve
    new = np.where(strain >= 0.0, _new(np.maximum(strain, 0.0)), _new(np.maximum(-strain, 0.0)))
    line = curve.line[~new][0] if not new.all() else 0
    if new.all():
        return curve
    return curve.at(
        new,
        f"{(~new).sum()} points of unloading and reloading removed (first: line {line}): the first loading counts, and "
        "rubber is softer after it (Mullins); --unloading keep uses them",
    )


def _monotonic(strain: Array) -> bool:
    noise = BACK * float(np.ptp(strain))
    grows = np.maximum.accumulate(strain) - strain
    falls = strain - np.minimum.accumulate(strain)
    return bool(grows.max() <= noise or falls.max() <= noise)


def _new(extent: Array) -> Array:
    """Return where an extent (n,) is larger than before, but for noise."""
    noise, largest, unloading = BACK * float(extent.max()), 0.0, False
    new = np.zeros(len(extent), dtype=bool)
    for k, value in enumerate(extent):
        unloading = value <= largest if unloading else value < largest - noise
        new[k] = not unloading and (value > 0.0 or largest == 0.0)
        largest = max(largest, float(value))
    return new


def _taut(curve: Curve, given: Given) -> Curve:
    """Return the curve with its strain counted from where the specimen is taut."""
    strain = curve.stretch - 1.0
    if given.slack is not None:
        slack, why = given.slack, "as --slack says"
    elif curve.strain_by == OPTICAL or strain.min() < -SMALLEST:
        return curve
    else:
        slack = find_slack(strain, curve.stress)
        why = "where the steepest tangent near the start meets zero stress; --slack 0 keeps the strain of the file"
    if slack == 0.0:
        return curve
    if given.slack is None and slack >= LARGEST:
        return curve.at(
            slice(None),
            f"the steepest tangent near the start meets zero stress at a strain of {slack:.2%}, which is much for "
            f"slack, so nothing is corrected: if the specimen was slack, give --slack {slack:.3g}; if not, --slack 0",
        )
    kept = strain >= slack
    moved = curve.at(kept, f"slack at the start: strain counts from {slack:.2%} of the file's, {why}")
    return Curve(**{**vars(moved), "stretch": moved.stretch - slack})

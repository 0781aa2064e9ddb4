"""Where a specimen slips or fails, and single points that the load cell has wrong, both told from its noise.

A fall of the stress under growing strain is slip or failure. It has to be large against the stress, large against the
noise, and it has to last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.tensile.curve import Curve
from cqrun.tensile.noise import noise_of
from cqrun.tensile.slack import SMALLEST

DROP, EARLY = 0.10, 0.05
"""A fall by this part of the stress ends the curve; not before the stress has reached the second part of its largest
value, because small forces are noisy."""

SMALL_DROP, AT_ONCE = 0.02, 3
"""A fall by this part within so few points is mentioned."""

SURE = 8.0
"""A fall, or the error of a wrong point, is more than so many standard deviations of the noise."""

LASTS = 3
"""A fall is there in the lines through so many points before and after it, too."""

GLITCH, SIDE, APART = 3, 3, 4.0
"""At most so many points in a row are wrong if so many points on each side lie on one line. The wrong ones are away
from this line by so many times what the others are."""


@dataclass(frozen=True)
class _Fall:
    """The last point before a fall, the first one that is low, and the part of the stress that is lost."""

    last: int
    first: int
    part: float


def without_glitches(curve: Curve) -> Curve:
    """Return the curve without points whose stress is far away from that of the points on both sides of them."""
    wrong = _glitches(curve.stretch, curve.stress)
    count = int(wrong.sum())
    if not count:
        return curve
    first = int(np.argmax(wrong))
    points, are = ("point", "is") if count == 1 else ("points", "are")
    return curve.at(
        ~wrong,
        f"{count} {points} removed (first: line {curve.line[first]}, {curve.stress[first]:.4g} Pa): the points before "
        f"and after lie on one line, and the stress {are} far away from it",
    )


def _glitches(strain: Array, stress: Array) -> Array:
    """Return which points (n,) are wrong."""
    n, wrong = len(stress), np.zeros(len(stress), dtype=bool)
    if n <= 2 * SIDE:
        return wrong
    least = np.maximum(SURE * noise_of(stress), DROP * np.maximum(np.abs(stress), EARLY * np.abs(stress).max()))
    bends = np.abs(stress[1:-1] - 0.5 * (stress[2:] + stress[:-2])) > 0.4 * np.minimum(least[2:], least[:-2])
    for start in (np.flatnonzero(bends) + 1).tolist():
        for end in range(start + 1, min(start + GLITCH, n - 2) + 1):
            if not wrong[start - 1] and _is_glitch(strain, stress, start, end, least):
                wrong[start:end] = True
                break
    return wrong


def _is_glitch(strain: Array, stress: Array, start: int, end: int, least: Array) -> bool:
    """Return whether the points from start to before end are wrong: not so at an edge of the curve, or of a slip."""
    around = np.r_[max(0, start - SIDE) : start, end : min(len(stress), end + SIDE)]
    inside = np.arange(start, end)
    steps = np.diff(strain[around])
    if not (np.all(steps > 0.0) or np.all(steps < 0.0)) or len(around) < 2 * SIDE - 1:
        return False
    line = np.polynomial.Polynomial.fit(strain[around], stress[around], 1)
    off, rest = stress[inside] - line(strain[inside]), np.abs(stress[around] - line(strain[around])).max()
    same_side = np.all(off > 0.0) or np.all(off < 0.0)
    limit = np.maximum(np.maximum(least[start - 1], APART * rest), DROP * np.abs(line(strain[inside])))
    return bool(same_side and np.all(np.abs(off) > limit))


def without_failure(curve: Curve) -> Curve:
    """Return the curve up to where its stress suddenly falls although the strain grows.

    A small fall that is no noise is mentioned, and the points after it stay.
    """
    strain, stress = np.abs(curve.stretch - 1.0), np.abs(curve.stress)
    if np.any(curve.stretch < 1.0 - SMALLEST) and np.any(curve.stretch > 1.0 + SMALLEST):
        return curve  # tension and compression in one curve: the stress passes zero
    fall = _fall(strain, stress, DROP, len(stress))
    if fall is None:
        small = _fall(strain, stress, SMALL_DROP, AT_ONCE)
        return curve if small is None else curve.at(slice(None), _mention(curve, small))
    last, after = fall.last, len(stress) - fall.last - 1
    there = f"at strain {strain[last]:.3g} (line {curve.line[last]}) the stress falls by {fall.part:.0%}"
    if stress[fall.first :].max() > stress[last]:
        what = f"{there} and grows again: the specimen slips in its grips; the {after} points after it are not used"
    else:
        what = f"{there}: the specimen fails; {after} points after it removed"
    return curve.at(slice(0, last + 1), what)


def _mention(curve: Curve, fall: _Fall) -> str:
    strain = curve.stretch[fall.last] - 1.0
    return (
        f"at strain {strain:.3g} (line {curve.line[fall.last]}) the stress falls by {fall.part:.0%} at once: the "
        "specimen may have slipped or torn a little there. The points after it are used; "
        f"--range {f':{strain:.3g}' if strain > 0.0 else f'{strain:.3g}:'} leaves them out"
    )


def _fall(strain: Array, stress: Array, part: float, within: int) -> _Fall | None:
    """Return the first fall of the stress (n,) by a part of it, within so many points, or None."""
    peak = np.maximum.accumulate(stress)
    at_peak = np.maximum.accumulate(np.where(stress == peak, np.arange(len(stress)), 0))
    least = np.maximum(part * peak, SURE * noise_of(stress))
    low = (stress < peak - least) & (strain >= strain[at_peak]) & (peak > EARLY * stress.max())
    for first in np.flatnonzero(low):
        last = int(at_peak[first])
        if first - last <= within and _step(stress, last, int(first)) > 0.5 * least[first]:
            return _Fall(last, int(first), _lost(stress, last))
    return None


def _step(stress: Array, last: int, first: int) -> float:
    """Return the fall from one point to a later one as the points before and after them tell it; one alone is noise."""
    before, after = stress[max(0, last - LASTS) : last], stress[first + 1 : first + 1 + LASTS]
    high = np.polyval(np.polyfit(np.arange(-len(before), 0), before, 1), 0.0) if len(before) > 1 else stress[last]
    low = np.polyval(np.polyfit(np.arange(1, len(after) + 1), after, 1), 0.0) if len(after) > 1 else stress[first]
    return float(high - low)


def _lost(stress: Array, last: int) -> float:
    """Return by which part the stress falls after its peak, before it grows again."""
    after = stress[last:]
    rises = np.flatnonzero(np.diff(after) > 0.0)
    rises = rises[rises > 0]
    lowest = after[: rises[0] + 1].min() if rises.size else after.min()
    return float(1.0 - lowest / stress[last])

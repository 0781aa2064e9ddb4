"""Whether tests in several files can be of one material: each is followed well alone, but no law follows them all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cqrun.explain import listed
from cqrun.tensile.choice import GOOD
from cqrun.tensile.curve import Curve
from cqrun.tensile.fits import fit_law
from cqrun.tensile.laws import Law

POOR = 0.05
"""No law follows all files if the best error is above this part of the largest stress."""

APART = 1.1
"""Stresses of two files differ if their ratio is more than this."""


def contradictions(curves: Sequence[Curve], laws: Sequence[Law], error: float) -> list[str]:
    """Return a warning if files contradict each other.

    Args:
        curves: of all files.
        laws: that were fitted to them together.
        error: of the law that fits best, relative to the largest stress.
    """
    files = list(dict.fromkeys(curve.source for curve in curves))
    if error < POOR or len(files) < 2:
        return []
    parts = [[curve for curve in curves if curve.source == name] for name in files]
    if not all(_fits(part, laws) for part in parts):
        return []
    ratio = next((text for k, part in enumerate(parts) for other in parts[:k] if (text := _ratio(other, part))), "")
    return [
        f"the files {listed(files)} contradict each other: a law follows each of them alone within {GOOD:.0%}, but the "
        f"best error for all together is {error:.1%}{ratio}. Are they two materials, or is a unit, an area, a length "
        "or a mode wrong in one of them? Fit them apart, or give --unit, --area, --gauge or --mode"
    ]


def _fits(curves: Sequence[Curve], laws: Sequence[Law]) -> bool:
    """Return whether a law follows curves well."""
    fits = (fit_law(law, curves) for law in laws)
    return any(fit is not None and fit.rms < GOOD for fit in fits)


def _ratio(first: Sequence[Curve], second: Sequence[Curve]) -> str:
    """Return by what the stresses of two files differ at the same strains in the same mode, if they do."""
    for a in first:
        for b in (curve for curve in second if curve.mode == a.mode):
            low, high = max(a.stretch.min(), b.stretch.min()), min(a.stretch.max(), b.stretch.max())
            if high <= low:
                continue
            there = np.linspace(low, high, 20)[1:]
            stresses = [np.interp(there, c.stretch[o], c.stress[o]) for c in (a, b) for o in [np.argsort(c.stretch)]]
            times = float(np.median(stresses[1]) / (np.median(stresses[0]) or np.nan))
            if max(times, 1.0 / times if times else np.inf) > APART:
                return f"; at the same strains {b.source} has {times:.3g} times the stress of {a.source}"
    return ""

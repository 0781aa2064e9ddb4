"""The material that tests give: laws with intervals, the chosen one, and sentences on how far it may be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.errors import DataError
from cqrun.materials.curves import MODES, Mode
from cqrun.tensile.agreement import contradictions
from cqrun.tensile.choice import GOOD, Judged, chosen, judge, one_of_each
from cqrun.tensile.columns import CROSSHEAD
from cqrun.tensile.curve import Curve
from cqrun.tensile.fits import Fit, fit_law
from cqrun.tensile.laws import Law
from cqrun.tensile.noise import noise_of
from cqrun.tensile.reading import modes_in

SOFTEST, STIFFEST = 1e4, 5e6
"""Young's moduli of silicones lie between these [Pa]."""

SECANT = 0.5
"""The modulus that is compared with them is a secant up to this strain."""

VAGUE = 4.0
"""An interval of the modulus at rest that ends at more than so many times where it begins is warned about."""

NOISY = 0.05
"""No load cell has more noise than this part of the largest stress."""

SLOPES = {"uniaxial": 3.0, "planar": 4.0, "equibiaxial": 6.0}
"""Slope of the nominal stress at rest, in shear moduli."""


@dataclass(frozen=True)
class Material:
    """What tests say of a material.

    Attributes:
        curves: the tests, cleaned.
        variants: every law with every number of terms.
        laws: one entry of each law.
        chosen: one of `laws`.
        ratio: Poisson's ratio in the scene.
        warnings: sentences on numbers that are probably wrong.
        trust: sentences on how far the material may be trusted.
    """

    curves: tuple[Curve, ...]
    variants: tuple[Fit, ...]
    laws: tuple[Judged, ...]
    chosen: Judged
    ratio: float
    warnings: tuple[str, ...]
    trust: tuple[str, ...]


def characterise(
    curves: Sequence[Curve], laws: Sequence[Law], ratio: float, announce: Callable[[str], None] = lambda text: None
) -> Material:
    """Fit laws to curves, compare them, and return the material.

    Args:
        curves: cleaned.
        laws: those to fit.
        ratio: Poisson's ratio that goes with them in a scene.
        announce: is called with what is done next.

    Raises:
        DataError: no law can be fitted.
    """
    fits: list[Fit] = []
    for law in laws:
        announce(f"fitting {law.title}")
        fit = fit_law(law, curves)
        if fit is not None:
            fits.append(fit)
    if not any(fit.law.moduli(fit.values).shear > 0.0 for fit in fits):
        sources = ", ".join(dict.fromkeys(curve.source for curve in curves))
        raise DataError(f"{sources}: no law fits: a material needs a stress that grows with the strain from rest")
    announce("comparing the laws")
    judged = judge(one_of_each(fits), curves)
    best = chosen(judged)
    disagreement = contradictions(curves, laws, min(fit.rms for fit in fits))
    warnings = (*_sizes(curves), *_noisy(curves), *disagreement, *weaknesses(best, contradicted=bool(disagreement)))
    return Material(
        tuple(curves), tuple(fits), tuple(judged), best, ratio, warnings, tuple(_trust(curves, judged, best))
    )


def _sizes(curves: Sequence[Curve]) -> list[str]:
    """Return a warning if the stress is of a size that no silicone has."""
    found = []
    for curve in curves:
        strain = curve.stretch - 1.0
        near = np.abs(strain) <= max(SECANT, float(np.sort(np.abs(strain))[1]))
        moduli = curve.stress[near] / np.where(strain[near] == 0.0, np.nan, strain[near])
        modulus = float(np.nanmedian(moduli)) * 3.0 / SLOPES[curve.mode]
        if SOFTEST <= modulus <= STIFFEST:
            continue
        size = "stiffer" if modulus > STIFFEST else "softer"
        meant = "MPa read for kPa, or a fraction read as percent" if size == "stiffer" else (
            "kPa read for MPa, or percent read as a fraction"
        )  # fmt: skip
        found.append(
            f"{curve.source}: a modulus of about {shown(modulus)} is {size} than any silicone (10 kPa to 5 MPa): are "
            f"the units right ({meant}), the area, and the length? Give --unit, --area or --gauge if not"
        )
    return found


def _noisy(curves: Sequence[Curve]) -> list[str]:
    """Return a warning on each curve whose stress jumps up and down."""
    parts = [(curve.source, noise_of(curve.stress) / curve.largest_stress) for curve in curves]
    return [
        f"{source}: the stress jumps up and down by about {part:.0%} of its largest value from line to line: are two "
        "specimens mixed in the file, or is another column the stress? Write each specimen to a file of its own, or "
        "give --column stress=N"
        for source, part in parts if part > NOISY
    ]  # fmt: skip


def weaknesses(best: Judged, *, contradicted: bool = False) -> list[str]:
    """Return warnings on the chosen law; if tests contradict each other, that is why its modulus is vague."""
    found = []
    for mode, stretch in best.unstable_in.items():
        found.append(
            f"{best.law.name} is unstable in {mode} tests from a stretch of {stretch:.3g}, inside the tested "
            "deformation (its nominal stress falls), and so is every other law: test other modes, or a smaller --range"
        )
    shear = best.certainty.shear
    if not contradicted and shear is not None and shear[1] > VAGUE * shear[0]:
        found.append(
            "the modulus at rest is hardly determined: its 95 % interval ends at "
            f"{shear[1] / shear[0]:.3g} times where it begins, because the law misses the curve at small strains; fit "
            "those alone, as with --range :1"
        )
    worst = [finding for finding in best.certainty.findings if "hard to tell apart" not in finding]
    return [*found, *(f"{best.law.name}: {finding}" for finding in worst)]


def _trust(curves: Sequence[Curve], judged: Sequence[Judged], best: Judged) -> list[str]:
    modes = modes_in(curves)
    ranges = []
    for mode in modes:
        own = [curve for curve in curves if curve.mode == mode]
        low, high = min(float(c.stretch.min()) for c in own), max(float(c.stretch.max()) for c in own)
        ranges.append(
            f"{mode} to a stretch of {high:.3g}" if low > 0.99 else f"{mode}, stretch {low:.3g} to {high:.3g}"
        )
    found = [f"tested: {'; '.join(ranges)}. Beyond this the law is a guess"]
    missing = [mode for mode in MODES if mode not in modes]
    if missing:
        found.append(f"not tested: {' and '.join(missing)}{_spread(judged, best, missing)}")
    if min(float(curve.stretch.min()) for curve in curves) > 0.99:
        found.append("not tested: compression")
    if any(curve.strain_by == CROSSHEAD for curve in curves):
        first = min(float(np.abs(c.stretch - 1.0)[np.abs(c.stretch - 1.0) > 0.0].min()) for c in curves)
        found.append(
            f"the strain is from the crosshead: the specimen's ends and the grips count, too, so moduli at rest are "
            f"uncertain by more than their intervals (the smallest strain is {first:.2%})"
        )
    found.append("the first loading counts: after a large stretch, filled rubber is softer below it (Mullins effect)")
    rates = [float(np.ptp(curve.stretch)) / time for curve in curves if (time := curve.duration) is not None]
    if rates:
        found.append(f"pulled at about {np.median(rates):.2g} 1/s: slower loads find it softer, faster ones stiffer")
    if len({curve.source for curve in curves}) == 1:
        found.append("one specimen or one file: batches and curing differ by tens of percent, which no interval shows")
    return found


def _spread(judged: Sequence[Judged], best: Judged, missing: Sequence[Mode]) -> str:
    """Return how much possible laws differ in the modes that were not tested."""
    limit = max(GOOD, best.fit.rms)
    possible = [item for item in judged if item.fit.rms <= limit and not item.unstable_in]
    if len(possible) < 2:
        return ""
    parts = []
    for mode in missing:
        stretch = np.linspace(1.0, best.needed[mode][1], 60)[1:]
        stresses = np.array([item.law.stress(item.fit.values, mode, stretch) for item in possible])
        here = best.law.stress(best.fit.values, mode, stretch)
        apart = float(np.max(np.ptp(stresses, axis=0) / np.max(here)))
        parts.append(f"{f'up to {apart:.0%}' if apart < 1.0 else 'more than 100%'} in {mode}")
    return (
        f"; the {len(possible)} laws that fit within {100.0 * limit:.3g}% differ there by {' and '.join(parts)}, "
        "relative to the largest stress"
    )


def shown(value: float) -> str:
    """Return a modulus with a unit that suits its size."""
    for unit, size in (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3)):
        if abs(value) >= size:
            return f"{value / size:.4g} {unit}"
    return f"{value:.4g} Pa"

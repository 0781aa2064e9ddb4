"""Young's moduli of fitted materials at small strains, with intervals: the numbers that a data sheet has.

Parameters of rubber laws are none, and a material whose stress relaxes has two: that after a long time, and that
against a sudden change, whose shear modulus is larger (`MaterialTerm.at_once`). A modulus E depends on the working
coordinates z of the unknowns, so var(log E) = s^T C s with s = d log E / dz and the covariance C of z.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cqrun.fitting.identifiability import Unknown
from cqrun.fitting.uncertainty import Uncertainty, student
from cqrun.materials.moduli import moduli_of
from cqrun.scene.material import Material
from cqrun.scene.paths import with_values
from cqrun.scene.schema import Scene
from cqrun.store.result import Modulus

STEP = 1e-4
"""Difference step in a working coordinate, relative to its size, or to the distance of its bounds if that is less."""

LONG, ONCE = "youngs_modulus", "youngs_modulus_at_once"


def fitted_moduli(
    scene: Scene, unknowns: Sequence[Unknown], uncertainty: Uncertainty | None, confidence: float = 0.95
) -> dict[str, dict[str, Modulus]]:
    """Return Young's moduli [Pa] of every body with an unknown in its law or branches, by body and kind.

    A modulus that is an unknown itself is left out, unless the stress relaxes. So are bodies with several values.

    Args:
        scene: any scene of the fit.
        unknowns: at the optimum.
        uncertainty: of the unknowns; None if it is not known.
    """
    found = {}
    for name in scene.bodies:
        own = [k for k, unknown in enumerate(unknowns) if unknown.name.startswith(f"bodies.{name}.material.")]
        if own and not any(unknowns[k].name.endswith("]") for k in own):
            moduli = _moduli(scene, name, unknowns, own, uncertainty, confidence)
            given = {unknowns[k].name.rpartition(".")[2] for k in own}
            if moduli and (ONCE in moduli or LONG not in given):
                found[name] = moduli
    return found


def _moduli(
    scene: Scene, body: str, unknowns: Sequence[Unknown], own: list[int], uncertainty: Uncertainty | None,
    confidence: float,
) -> dict[str, Modulus]:  # fmt: skip
    """Return those moduli of a body that its unknowns, with the numbers `own`, change."""
    z = np.array([unknowns[k].coordinate for k in own])

    def logarithms(point: np.ndarray) -> np.ndarray:
        values = {unknowns[k].name: unknowns[k].from_coordinate(c) for k, c in zip(own, point, strict=True)}
        return np.log(list(small_strain_moduli(with_values(scene, values).bodies[body].material).values()))

    here, names = logarithms(z), list(small_strain_moduli(scene.bodies[body].material))
    # at a bound the difference is one-sided: a value beyond it may be none, such as a negative ratio
    lower, upper = np.array([unknowns[k].ends for k in own]).T
    steps = STEP * np.minimum(np.maximum(np.abs(z), 1.0), upper - lower)
    ends = np.maximum(z - steps, lower), np.minimum(z + steps, upper)
    slopes = [
        (logarithms(np.where(e, ends[1], z)) - logarithms(np.where(e, ends[0], z))) / (ends[1][k] - ends[0][k])
        for k, e in enumerate(np.eye(len(z), dtype=bool))
    ]
    moduli = {}
    for name, log_e, slope in zip(names, here, np.array(slopes).T, strict=True):
        interval = None
        used = np.flatnonzero(np.abs(slope) > 1e-9)
        if not len(used):
            continue
        place = np.array(own)[used]
        if uncertainty is not None and np.isfinite(uncertainty.covariance[np.ix_(place, place)]).all():
            error = np.sqrt(slope[used] @ uncertainty.covariance[np.ix_(place, place)] @ slope[used])
            half = student(float(uncertainty.degrees[place].min()), confidence) * error
            interval = (float(np.exp(log_e - half)), float(np.exp(log_e + half)))
        moduli[name] = Modulus(value=float(np.exp(log_e)), interval=interval)
    return moduli


def small_strain_moduli(material: Material) -> Mapping[str, float]:
    """Return Young's modulus at rest [Pa], and against a sudden change where the stress relaxes; empty if unknown."""
    moduli = moduli_of(material.elastic.value)
    if moduli is None:
        return {}
    terms = [term for term in material.terms.values() if term.relaxes]  # type: ignore[attr-defined]  # a term, by its kind
    if not terms:
        return {LONG: moduli.young}
    shear = moduli.shear * float(np.prod([term.at_once for term in terms]))  # type: ignore[attr-defined]
    return {LONG: moduli.young, ONCE: 9.0 * moduli.bulk * shear / (3.0 * moduli.bulk + shear)}

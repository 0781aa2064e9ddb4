"""The moduli of an elastic law at rest, by which laws with other parameters are compared."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.materials.curves import FARTHEST, stable_to
from cqrun.plugin.contract import Array


class Moduli(NamedTuple):
    """Shear modulus mu, bulk modulus K and Young's modulus E [Pa], and Poisson's ratio nu, each (n,) or a number."""

    shear: Any
    bulk: Any
    young: Any
    ratio: Any


def moduli_at(spec: Any, theta: Array) -> Moduli | None:
    """Return the moduli at rest for rows of parameters theta (rows, n); None if the law does not tell its mu.

    K = rho c^2 - 4/3 mu from the stiffness of a pressure wave, E = 9 K mu / (3 K + mu), nu = (3 K - 2 mu) / (6 K + 2
    mu).
    """
    shear = np.asarray(spec.shear_modulus(theta))
    if not np.any(shear):
        return None
    bulk = np.asarray(spec.wave_modulus(theta)) - 4.0 / 3.0 * shear
    below = 3.0 * bulk + shear
    return Moduli(shear, bulk, 9.0 * bulk * shear / below, (3.0 * bulk - 2.0 * shear) / (2.0 * below))


def moduli_of(spec: Any) -> Moduli | None:
    """Return the moduli at rest of a law of a scene, as numbers; None if the law does not tell its mu."""
    found = moduli_at(spec, np.array([[getattr(spec, name)] for name in spec.parameters]))
    return None if found is None else Moduli(*(float(value[0]) for value in found))


def at_rest_words(spec: Any) -> str:
    """Return a law's moduli at rest, and up to which stretch it is stable, as text; empty if they are not known."""
    moduli = moduli_of(spec)
    if moduli is None:
        return ""
    stable = stable_to(spec, np.array([getattr(spec, name) for name in spec.parameters]))
    mode, end = min(stable.items(), key=lambda item: item[1])
    held = f"stable up to a stretch of {end:.3g} ({mode})" if end < FARTHEST else f"stable up to a stretch of {end:g}"
    numbers = f"mu {moduli.shear:.4g} Pa, K {moduli.bulk:.4g} Pa, E {moduli.young:.4g} Pa, nu {moduli.ratio:.5g}"
    return f"{numbers} at rest; {held}"

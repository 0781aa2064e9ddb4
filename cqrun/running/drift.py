"""How far positions have drifted from the deformation gradient in the updated frame.

There, a particle's position and its F are integrated apart: x by the velocity, F by the velocity's gradient. Their
errors differ, so after a while neighbours are not where F says. In the reference frame both come from the same
displacements.
For neighbours i and j at rest, F predicts the distance |(F_i + F_j) / 2 (X_j - X_i)|. Where the deformation changes
over a cell, single pairs differ in both frames, because F is an average; so the mean over all pairs of a body counts.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cqrun.build.model import Built
from cqrun.plugin.contract import Array
from cqrun.running.observables import fracture_of
from cqrun.state import State

NOTABLE = 0.01
"""Mean relative difference from which it is reported."""


def drift(pairs: Array, X: Array, state: State) -> float:
    """Return the mean of |x_j - x_i| over the predicted distance, less 1, for pairs (P, 2) at rest at X (N, D)."""
    i, j = pairs.T
    predicted = np.einsum("pij,pj->pi", 0.5 * (state.F[i] + state.F[j]), X[j] - X[i])
    ratio = np.linalg.norm(state.x[j] - state.x[i], axis=1) / np.linalg.norm(predicted, axis=1)
    return float(np.mean(ratio)) - 1.0


def drift_findings(built: Built, last: State) -> Iterator[str]:
    """Yield a sentence for each body whose positions have drifted from F; none in the reference frame."""
    if built.model.frame != "updated":
        return
    fracture = fracture_of(built)
    lost = fracture.count(last.x)
    for name, pairs in fracture.pairs.items():
        if lost[name] or not len(pairs):
            continue  # a body that tears is told as such
        with np.errstate(all="ignore"):
            size = drift(pairs, built.particles.x, last)
        if abs(size) > NOTABLE:
            apart = f"{100 * abs(size):.1f} % {'farther apart' if size > 0 else 'closer'}"
            yield (
                f"{name}: at the end, neighbours are {apart} than its deformation gradient says, because the updated"
                " frame integrates both apart: a shorter run drifts less, and `world.frame: reference` does not drift"
            )

"""Averaged volumes in plain NumPy: slow, complex, and sharing no code with the engine.

The energies of volume act at the corners of cells, between the nodes: J_c = sum_p N vol0 J / V, and so do parameters.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from reference import Array, determinant
from split_nodes import layers

from cqrun.engine.model import Inputs, Model


def corners(model: Model, X: Array) -> Iterator[tuple[Array, Array]]:
    """Yield (corner, weight) of every particle; the corners of a body have numbers of their own."""
    body = np.repeat(np.arange(len(model.layout.counts)), model.layout.counts)
    low = np.floor(X.real / model.dx - 0.5).astype(int)
    place = X / model.dx - 0.5 - low
    shape, layer = np.array(model.grid_shape) + 20, layers(model, X)
    for which in np.ndindex(*(2,) * model.dim):
        number = np.ravel_multi_index(tuple((low + which + 10).T), tuple(shape))
        yield (
            number + (body + len(model.layout.counts) * layer[which]) * int(np.prod(shape)),
            np.prod(np.where(which, place, 1.0 - place), axis=1),
        )


def slopes(parameters: list[Array], J: Array) -> Array:
    """Return the sum of U' of fixed corotated, neo-Hookean and the penalty on volume."""
    (E, nu), (E_2, nu_2), (E_3, nu_3) = parameters
    lam, lam_2 = (e * n / ((1 + n) * (1 - 2 * n)) for e, n in ((E, nu), (E_2, nu_2)))
    return lam * (J - 1) + lam_2 * np.log(J) / J + E_3 / (3 * (1 - 2 * nu_3)) * (J - 1)


def means(found: list[tuple[Array, Array]], a: Array, volume: Array) -> Array:
    """Return for each corner the mean of a number of the particles; zero where no particle is."""
    count = max(int(corner.max()) for corner, _ in found) + 1
    total, V = (np.zeros(count, np.result_type(a, volume, *(weight for _, weight in found))) for _ in range(2))
    for corner, weight in found:
        np.add.at(total, corner, weight * volume * a)
        np.add.at(V, corner, weight * volume)
    return np.divide(total, V, out=np.zeros_like(total), where=V != 0)


def more_stress(model: Model, inputs: Inputs, X: Array, F: Array) -> Array:
    """Return what mean volumes add to the Kirchhoff stress of every particle (N, D, D)."""
    fixed, neo, _, penalty = inputs.terms[0][:4]
    own, found, J = [fixed, neo, penalty], list(corners(model, X)), determinant(F)
    at_corners = [[means(found, row, inputs.fields.volume) for row in term] for term in own]
    mean_J = means(found, J, inputs.fields.volume)
    full = mean_J != 0
    slope = np.zeros_like(mean_J)
    slope[full] = slopes([[row[full] for row in term] for term in at_corners], mean_J[full])
    pressure = sum(weight * slope[corner] for corner, weight in found)
    return ((pressure - slopes(own, J)) * J)[:, None, None] * np.eye(model.dim)

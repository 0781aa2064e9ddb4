"""From few numbers to one for every particle: linear maps whose rows sum to 1, so that bounds on the few hold for all.

A smooth field is a sum of quadratic B-splines on a grid over the body (the same functions that carry momentum to the
grid); a mirrored body has one number for each pair of particles, or a field that is the mean of itself and its image.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

NEAR = 0.3
"""Distance of a mirrored point from its partner, in distances to the nearest neighbour, that is still a match."""

ALIKE = 0.9
"""Part of the particles of two groups that are one another's mirror images where the groups are."""


def field(x: Array, resolution: int) -> csr_array:
    """Return the values (n, k) of quadratic B-splines at points x (n, D).

    Args:
        resolution: cells of the grid along the longest edge of the points' box; k is (cells + 2) to the power of D.
    """
    from scipy.sparse import csr_array

    low, high = x.min(axis=0), x.max(axis=0)
    cell = float((high - low).max()) / resolution or 1.0  # of one point any will do
    cells = np.maximum(1, np.ceil((high - low) / cell - 1e-9).astype(int))
    place = np.clip((x - low) / cell, 0.0, cells - 1e-9)
    first = np.floor(place).astype(int)
    u = place - first
    weights = np.stack([0.5 * (1 - u) ** 2, 0.5 + u - u**2, 0.5 * u**2], axis=1)  # (n, 3, D): of nodes first + 0, 1, 2
    nodes = cells + 2
    columns, values = [], []
    for offset in itertools.product(range(3), repeat=x.shape[1]):
        index = first + np.array(offset)
        columns.append(np.ravel_multi_index(tuple(index.T), tuple(nodes)))
        values.append(np.prod([weights[:, o, d] for d, o in enumerate(offset)], axis=0))
    n, each = len(x), len(columns)
    starts = each * np.arange(n + 1)
    data = (np.array(values).T.reshape(-1), np.array(columns).T.reshape(-1), starts)
    return csr_array(data, shape=(n, int(np.prod(nodes))))


def mirrored(x: Array, axis: int) -> Array:
    """Return points (n, D) mirrored across the middle of their box along an axis."""
    image = x.copy()
    image[:, axis] = x[:, axis].min() + x[:, axis].max() - x[:, axis]
    return image


def mirrored_field(x: Array, resolution: int, axis: int) -> csr_array:
    """Return a field (n, k) that is the mean of itself and its mirror image."""
    from scipy.sparse import csr_array

    both = field(np.concatenate([x, mirrored(x, axis)]), resolution)
    return csr_array(0.5 * (both[: len(x)] + both[len(x) :]))


def partners(x: Array, axis: int, what: str) -> Array:
    """Return the mirror image (n,) of each of points x (n, D), at least two, among them.

    Args:
        what: the points are called in an error.

    Raises:
        UsageError: a point has no mirror image among the others.
    """
    from scipy.spatial import cKDTree

    tree, image = cKDTree(x), mirrored(x, axis)
    spacing = tree.query(x, k=2)[0][:, 1]
    distance, partner = tree.query(image)
    lone = np.flatnonzero((distance > NEAR * spacing) | (partner[partner] != np.arange(len(x))))
    if len(lone):
        k = int(lone[0])
        place = ", ".join(f"{a:.5g}" for a in x[k])
        raise UsageError(
            f"{len(lone)} of {len(x)} {what} have no mirror image across {'xyz'[axis]}, the first at ({place}) m: "
            "symmetry needs a body that is its own mirror image; leave out `mirror`, or use a field"
        )
    return np.asarray(partner)


def pairs(partner: Array) -> csr_array:
    """Return a map (n, k) from one number for each pair; one on the middle plane is its own partner (n,)."""
    from scipy.sparse import csr_array

    n = len(partner)
    _, column = np.unique(np.minimum(np.arange(n), partner), return_inverse=True)
    return csr_array((np.ones(n), column, np.arange(n + 1)), shape=(n, int(column.max()) + 1))


def group_partners(groups: Mapping[str, Array], partner: Array, axis: int, what: str) -> Array:
    """Return which of a body's groups (G,) is the mirror image of each.

    Args:
        groups: which particles (n,) each holds, by name.
        partner: mirror image of each particle (n,).
        what: the body is called in an error.

    Raises:
        UsageError: a group has no mirror image among the others.
    """
    held = np.array(list(groups.values()), dtype=float)  # (G, n)
    both = held @ held[:, partner].T
    alike = both / np.maximum(1.0, held.sum(axis=1)[:, None] + held.sum(axis=1) - both)
    found = np.argmax(alike, axis=1)
    lone = [name for k, name in enumerate(groups) if alike[k, found[k]] < ALIKE or found[found[k]] != k]
    if lone:
        raise UsageError(
            f"{len(lone)} of {len(groups)} groups of {what} have no mirror image across {'xyz'[axis]}: {listed(lone)}; "
            "symmetry needs groups of mirrored particles; leave out `mirror`, or use a field"
        )
    return np.asarray(found)


def shifted(x: Array, y: Array, what: str, of_what: str) -> Array:
    """Return, for each of points y (n, D), which of points x (n, D) it is where y is moved onto x.

    Args:
        what, of_what: y and x are called in an error.

    Raises:
        UsageError: y is not x in another place.
    """
    from scipy.spatial import cKDTree

    if len(x) == len(y):
        tree = cKDTree(x)
        spacing = tree.query(x, k=2)[0][:, 1] if len(x) > 1 else np.ones(1)
        distance, found = tree.query(y - y.min(axis=0) + x.min(axis=0))
        if (distance <= NEAR * spacing[found]).all() and len(np.unique(found)) == len(x):
            return np.asarray(found)
    raise UsageError(
        f"the {len(y):,} {what} are not the {len(x):,} {of_what} in another place: they must match one by one"
    )

"""Linear maps from a few numbers to a value for every particle.

Entries are not negative and rows sum to 1, so values keep the bounds of the numbers. A smooth field is a sum of
quadratic B-splines on a grid over the body, as in the transfer of momentum to the grid. A mirrored body has one number
for each pair of particles, or a field that is the mean of itself and its mirror image.
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
"""Largest distance of a mirrored point from its partner, in distances to the nearest neighbour."""

ALIKE = 0.9
"""Share of common particles at which a group and a mirrored group are mirror images of each other."""


def field(x: Array, resolution: int) -> csr_array:
    """Return the values (n, k) of quadratic B-splines at points x (n, D).

    Args:
        resolution: number of cells along the longest edge of the points' bounding box; k is the product of (cells + 2)
            over the axes.
    """
    from scipy.sparse import csr_array

    low, high = x.min(axis=0), x.max(axis=0)
    cell = float((high - low).max()) / resolution or 1.0  # a single point has no extent; any size will do
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
    """Return points (n, D) mirrored across the middle of their bounding box along an axis."""
    image = x.copy()
    image[:, axis] = x[:, axis].min() + x[:, axis].max() - x[:, axis]
    return image


def mirrored_field(x: Array, resolution: int, axis: int) -> csr_array:
    """Return a map (n, k) to fields that are equal to their mirror image."""
    from scipy.sparse import csr_array

    both = field(np.concatenate([x, mirrored(x, axis)]), resolution)
    return csr_array(0.5 * (both[: len(x)] + both[len(x) :]))


def partners(x: Array, axis: int, what: str) -> Array:
    """Return for each of at least two points x (n, D) the index of its mirror image among them (n,).

    Args:
        what: name of the points in an error message.

    Raises:
        UsageError: a point has no mirror image among the others.
    """
    from scipy.spatial import cKDTree

    tree, image = cKDTree(x), mirrored(x, axis)
    spacing = tree.query(x, k=2)[0][:, 1]
    distance, partner = tree.query(image)
    unmatched = np.flatnonzero((distance > NEAR * spacing) | (partner[partner] != np.arange(len(x))))
    if len(unmatched):
        k = int(unmatched[0])
        place = ", ".join(f"{a:.5g}" for a in x[k])
        raise UsageError(
            f"{len(unmatched)} of {len(x)} {what} have no mirror image across {'xyz'[axis]}, the first at ({place}) m: "
            "symmetry needs a body that is its own mirror image; leave out `mirror`, or use a field"
        )
    return np.asarray(partner)


def pairs(partner: Array) -> csr_array:
    """Return the map (n, k) from a number for each pair; a point on the middle plane is its own partner (n,)."""
    from scipy.sparse import csr_array

    n = len(partner)
    _, column = np.unique(np.minimum(np.arange(n), partner), return_inverse=True)
    return csr_array((np.ones(n), column, np.arange(n + 1)), shape=(n, int(column.max()) + 1))


def group_partners(groups: Mapping[str, Array], partner: Array, axis: int, what: str) -> Array:
    """Return for each of a body's groups the index of its mirror image (G,).

    Args:
        groups: for each group, by name, which particles belong to it (n,) bool.
        partner: index of each particle's mirror image (n,).
        what: name of the body in an error message.

    Raises:
        UsageError: a group has no mirror image among the others.
    """
    member = np.array(list(groups.values()), dtype=float)  # (G, n)
    common = member @ member[:, partner].T
    alike = common / np.maximum(1.0, member.sum(axis=1)[:, None] + member.sum(axis=1) - common)
    image = np.argmax(alike, axis=1)
    unmatched = [name for k, name in enumerate(groups) if alike[k, image[k]] < ALIKE or image[image[k]] != k]
    if unmatched:
        raise UsageError(
            f"{len(unmatched)} of {len(groups)} groups of {what} have no mirror image across {'xyz'[axis]}: "
            f"{listed(unmatched)}; "
            "symmetry needs groups of mirrored particles; leave out `mirror`, or use a field"
        )
    return np.asarray(image)


def shifted(x: Array, y: Array, what: str, of_what: str) -> Array:
    """Return for each of points y (n, D) the index of the same point in x (n, D), where y is x moved and reordered.

    Args:
        what, of_what: names of y and x in an error message.

    Raises:
        UsageError: y is not a moved copy of x.
    """
    from scipy.spatial import cKDTree

    if len(x) == len(y):
        tree = cKDTree(x)
        spacing = tree.query(x, k=2)[0][:, 1] if len(x) > 1 else np.ones(1)
        distance, match = tree.query(y - y.min(axis=0) + x.min(axis=0))
        if (distance <= NEAR * spacing[match]).all() and len(np.unique(match)) == len(x):
            return np.asarray(match)
    raise UsageError(
        f"the {len(y):,} {what} are not the {len(x):,} {of_what} in another place: they must match one by one"
    )

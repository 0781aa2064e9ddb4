"""Nodes that are split: each side of a narrow gap in a body has nodes of its own.

A stencil reaches 1.5 cells to each side, so the walls of a gap of less than 3 cells would share nodes, and the gap
would neither open nor close freely. Here the particles around a node are sorted into pieces that hang together within
its reach. Each piece has a node of its own at that place: the first has that of the body's box, the others have further
nodes after the box. (N. Molino et al. copy the nodes of elements in this way: A virtual node algorithm for changing
mesh topology during simulation, ACM Transactions on Graphics 23 (2004).)

Neighbours on a lattice hang together: particles at most `REACH` spacings apart. So a gap must miss at least one layer
of the lattice. Nodes within a cell and a half of its end are shared, so a gap is too stiff there.

The stencil of a particle is then a row of a table, not a step of constant strides. Particles of one cell that hang
together have the same row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cqrun.plugin.contract import Array

REACH = 1.75
"""Spacings within which particles hang together: a little more than the diagonal of a cube, and less than two."""


class Split(NamedTuple):
    """The split nodes of one body.

    `place` (E,) is the node of the box at the place of each further node. `table` (C, 3^D) has the nodes of each
    stencil, numbered from the body's first on, with the further ones after those of the box. `row` (N_b,) is the row of
    each particle.
    """

    place: Array
    table: Array
    row: Array


def split_nodes(x: Array, base: Array, shape: Array, spacing: float) -> Split | None:
    """Return the split nodes of a body; None if no node is split.

    Args:
        x: its particles on their lattice (N_b, D) [m], which tells neighbours in any shape.
        base: the first node of each stencil (N_b, D), counted from the lower corner of the body's box.
        shape: nodes of that box along each axis (D,).
        spacing: distance between neighbours on the lattice [m].
    """
    piece, pairs = _pieces_of_cells(x, base, shape, spacing)
    first = np.unique(piece, return_index=True)[1]
    cell = base[first]
    offsets = np.indices((3,) * x.shape[1]).reshape(x.shape[1], -1).T
    place = np.ravel_multi_index(tuple((cell[:, None] + offsets).transpose(2, 0, 1)), tuple(shape))
    label = _labels(cell, pairs, place)
    # of each place the pieces with the lowest label keep the node of the box
    node = np.zeros(label.max() + 1, np.int64)
    node[label] = place  # all pieces with one label are at one place
    order = np.argsort(node, kind="stable")
    further = order[np.flatnonzero(np.diff(node[order], prepend=-1) == 0)]
    if not len(further):
        return None
    places = node[further]
    node[further] = int(np.prod(shape)) + np.arange(len(further))
    return Split(places, node[label], piece)


def _pieces_of_cells(x: Array, base: Array, shape: Array, spacing: float) -> tuple[Array, Array]:
    """Return the piece of each particle, and which pieces hang together (P, 2).

    A piece has the particles of one cell that hang together within it.
    """
    pairs = cKDTree(x).query_pairs(REACH * spacing, output_type="ndarray")
    number = np.ravel_multi_index(tuple(base.T), tuple(shape))
    inside = pairs[number[pairs[:, 0]] == number[pairs[:, 1]]]
    piece = _components(len(x), inside)
    between = np.sort(piece[pairs], axis=1)
    key = np.unique(between[:, 0] * len(x) + between[:, 1])
    apart = np.stack([key // len(x), key % len(x)], axis=1)
    return piece, apart[apart[:, 0] != apart[:, 1]]


def _labels(cell: Array, pairs: Array, place: Array) -> Array:
    """Return for each piece and each place of its stencil (C, 3^D) a number of the pieces that hang together there.

    Args:
        cell: of each piece (C, D).
        pairs: pieces that hang together (P, 2).
        place: the nodes of the stencils (C, 3^D).
    """
    dim, count = cell.shape[1], place.shape[1]
    step = cell[pairs[:, 1]] - cell[pairs[:, 0]]
    links = []
    for k, offset in enumerate(np.indices((3,) * dim).reshape(dim, -1).T):
        there = offset - step  # the same place in the stencil of the other piece
        both = np.flatnonzero(((there >= 0) & (there < 3)).all(axis=1))
        other = np.ravel_multi_index(tuple(there[both].T), (3,) * dim)
        links.append(np.stack([pairs[both, 0] * count + k, pairs[both, 1] * count + other], axis=1))
    return _components(place.size, np.concatenate(links)).reshape(place.shape)


def _components(count: int, links: Array) -> Array:
    """Return the number of the connected part of each of `count` things, increasing with its first member."""
    ones = np.ones(len(links), bool)
    graph = sparse.coo_array((ones, (links[:, 0], links[:, 1])), shape=(count, count))
    n_parts, found = connected_components(graph, directed=False)
    first = np.zeros(n_parts, np.int64)
    first[found[::-1]] = np.arange(count)[::-1]  # the last written, that is the first member, stays
    rank = np.zeros(n_parts, np.int64)
    rank[np.argsort(first)] = np.arange(n_parts)
    return np.asarray(rank[found])

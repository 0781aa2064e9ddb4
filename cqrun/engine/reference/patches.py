"""The nodes of each body in the reference frame, and the order of its particles, which never change.

Each body has nodes of its own, those of the rest grid that its stencils reach: bodies do not feel each other through
the grid. So the grid of each body may be shifted by less than a cell (`Model.offset`). All bodies' nodes lie in one
array, with the same strides. A body's nodes fill a box as deep and wide as the largest of any body, so that an index
needs no table; boxes follow each other. If a body has a narrow gap, further nodes follow its box, and stencils are rows
of a table (`split.py`).

Particles are sorted once, by colour and block as in `blocks.py`. Consecutive blocks of a colour form units of at least
`UNIT` particles, each padded to whole lanes. Units of one colour share no node, so threads can take them in any order.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from cqrun.engine.blocks import BLOCK
from cqrun.engine.lattice import Lattice
from cqrun.engine.reference.split import Split, split_nodes
from cqrun.engine.setting import MARGIN
from cqrun.plugin.contract import Array
from cqrun.state import PADDING, Layout

UNIT = 256
"""Number of particles from which a unit is full: enough work for a thread, and little padding."""

REACH = 3
"""Nodes of a stencil along an axis."""


@dataclass(frozen=True)
class SortedLayout(Layout):
    """A layout whose columns are sorted.

    `column` (N,) is the kernel column of each particle, `source` (n,) the particle of each column, and `lengths` the
    padded length of each body.
    """

    column: Array = field(default_factory=lambda: np.zeros(0, np.int64), compare=False)
    source: Array = field(default_factory=lambda: np.zeros(0, np.int64), compare=False)
    lengths: tuple[int, ...] = ()

    @property
    def padded(self) -> tuple[int, ...]:
        """Padded length of each body."""
        return self.lengths

    def columns(self) -> Array:
        """Return the kernel column of each particle (N,)."""
        return self.column

    def sources(self) -> Array:
        """Return the particle of each kernel column (n,); a padding column copies the last particle of its unit."""
        return self.source


class Patches(NamedTuple):
    """The nodes and units of all bodies.

    `first` (n,) and `f` (n, D) are the stencil of each column: the box's node at its lower corner, and the particle's
    place in it [cells]. `origin` (B, D) is the grid node, as in the world's grid, at the lower corner of each body's
    box, `deep` (B,) the nodes of the box along the first axis, and `begin` (B + 1,) where a body's nodes begin. Those
    of its box are the first. Then come further ones, at the places of the nodes `split` (E,) of the box. If there are
    any, row `row` (n,) of `table` (C, 3^D) has the nodes of a column's stencil; otherwise both are empty. `units`
    (U, 2) are the columns of each unit, in the order of bodies and colours; `colours` (B, 9) is where the units of each
    body and colour begin.
    """

    layout: SortedLayout
    first: Array
    f: Array
    strides: tuple[int, int, int]
    box: Array  # (D,) nodes of a box along each axis but the first
    deep: Array
    origin: Array
    begin: Array
    units: Array
    colours: Array
    offset: Array  # (B, D) of each body's grid from that of the world [m]
    split: Array
    table: Array
    row: Array

    @property
    def n_nodes(self) -> int:
        """Number of nodes of all bodies."""
        return int(self.begin[-1])

    def body_of_nodes(self) -> Array:
        """Return the body of each node (M,)."""
        return np.repeat(np.arange(len(self.origin)), np.diff(self.begin))

    def shapes(self) -> list[tuple[int, ...]]:
        """Return the numbers of nodes of each body's box along the axes."""
        return [(int(deep), *(int(each) for each in self.box[1:])) for deep in self.deep]

    def in_boxes(self) -> Array:
        """Return for each node (M,) the number of the one at its place among those of all boxes."""
        pieces, boxes, further = [], 0, 0
        for body, shape in enumerate(self.shapes()):
            count, begin = int(np.prod(shape)), int(self.begin[body])
            more = int(self.begin[body + 1]) - begin - count
            places = self.split[further : further + more] - begin
            pieces.append(boxes + np.concatenate([np.arange(count), places]))
            boxes, further = boxes + count, further + more
        return np.concatenate(pieces)

    def positions(self, dx: float) -> Array:
        """Return the position of each node at rest (M, D) [m]."""
        pieces = []
        for body, (origin, shape) in enumerate(zip(self.origin, self.shapes(), strict=True)):
            axes = [np.arange(count) + first - MARGIN for count, first in zip(shape, origin, strict=True)]
            grid = np.meshgrid(*axes, indexing="ij")
            pieces.append(np.stack(grid, axis=-1).reshape(-1, len(origin)) * dx + self.offset[body])
        return np.concatenate(pieces)[self.in_boxes()]

    def nodes_of(self, columns: Array) -> Array:
        """Return the nodes of the stencils of kernel columns (P, 3^D)."""
        return self.table[self.row[columns]] if len(self.table) else self._within(columns, 3)

    def corners_of(self, columns: Array) -> Array:
        """Return the nodes below the corners of the cells of kernel columns (P, 2^D)."""
        if not len(self.table):
            return self._within(columns, 2)
        dim = self.f.shape[1]
        lower = np.ravel_multi_index(tuple(np.indices((2,) * dim).reshape(dim, -1)), (3,) * dim)
        return np.asarray(self.table[self.row[columns]][:, lower])

    def _within(self, columns: Array, width: int) -> Array:
        dim = self.f.shape[1]
        steps = np.indices((width,) * dim).reshape(dim, -1).T @ np.array(self.strides[3 - dim :])
        return np.asarray(self.first[columns][:, None] + steps)


def count_nodes(layout: Layout, x: Array, dx: float, offset: Array | None = None) -> int:
    """Return the number of nodes of all bodies at rest at x (N, D) [m], in user order; arguments as `make_patches`."""
    _, extent = _boxes(layout, np.floor(_in_cells(layout, x, dx, offset) - 0.5).astype(np.int64))
    return int(extent[:, 0].sum() * np.prod(extent.max(axis=0)[1:]))


def _boxes(layout: Layout, base: Array) -> tuple[Array, Array]:
    """Return the first node of each body's box, and its nodes along each axis, (B, D) each."""
    parts = layout.slices()
    origin = np.array([base[part].min(axis=0) for part in parts])
    return origin, np.array([base[part].max(axis=0) for part in parts]) - origin + REACH


def _in_cells(layout: Layout, x: Array, dx: float, offset: Array | None) -> Array:
    """Return positions (N, D) in cells of the grids of their bodies."""
    own = 0.0 if offset is None else np.repeat(offset, layout.counts, axis=0)
    return (x - own) / dx + MARGIN


def make_patches(
    layout: Layout, x: Array, dx: float, offset: Array | None = None, lattice: Lattice | None = None
) -> Patches:
    """Return the nodes and the order of particles at rest.

    Args:
        x: positions (N, D) [m], in user order.
        offset: of each body's grid from that of the world (B, D) [m]; 0 if absent.
        lattice: of the particles; without one, no node is split.
    """
    dim = layout.dim
    cells = _in_cells(layout, x, dx, offset)
    base = np.floor(cells - 0.5).astype(np.int64)
    parts = layout.slices()
    origin, extent = _boxes(layout, base)
    box = extent.max(axis=0)
    inner = np.append(np.cumprod(box[:0:-1])[::-1], 1)  # strides of row-major nodes
    strides = (0, *(int(s) for s in inner)) if dim == 2 else tuple(int(s) for s in inner)
    shapes = [(int(each), *box[1:]) for each in extent[:, 0]]
    lattice = lattice or Lattice(x, np.zeros(len(parts)))
    splits = [
        split_nodes(lattice.x[part], base[part] - low, shape, spacing) if spacing > 0.0 else None
        for part, low, shape, spacing in zip(parts, origin, shapes, lattice.spacing, strict=True)
    ]
    more = np.array([0 if each is None else len(each.place) for each in splits])
    begin = np.concatenate([[0], np.cumsum(np.prod(shapes, axis=1) + more)]).astype(np.int64)
    column, source = np.zeros(len(x), np.int64), []
    lengths, units, colours, total = [], [], [], 0
    for part, low in zip(parts, origin, strict=True):
        order, pieces, starts = _in_units((base[part] - low) // BLOCK)
        colours.append(np.array(starts) + len(units))
        here = total
        for first, last in pieces:
            members = order[first:last] + part.start
            padded = -(-len(members) // PADDING) * PADDING
            column[members] = total + np.arange(len(members))
            source.append(np.append(members, np.full(padded - len(members), members[-1])))
            units.append((total, total + padded))
            total += padded
        lengths.append(total - here)
    sources = np.concatenate(source)
    body = np.repeat(np.arange(len(parts)), layout.counts)[sources]
    first = begin[body] + (base[sources] - origin[body]) @ inner
    sorted_layout = SortedLayout(dim, layout.counts, layout.history, column, sources, tuple(lengths))
    f = cells[sources] - base[sources]
    split = _joined(splits, parts, begin, first, strides, sources)
    return Patches(
        sorted_layout, first, f, strides, box, extent[:, 0], origin, begin, np.array(units, np.int64),  # type: ignore[arg-type]
        np.array(colours, np.int64), np.zeros(origin.shape) if offset is None else offset, *split,
    )  # fmt: skip


def _joined(
    splits: list[Split | None], parts: tuple[slice, ...], begin: Array, first: Array, strides: tuple[int, int, int],
    sources: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return the places of further nodes, the table, and the row of each column; empty if no body is split.

    In a body that is not split every stencil has a row of its own.
    """
    if all(each is None for each in splits):
        return np.zeros(0, np.int64), np.zeros((0, 0), np.int64), np.zeros(0, np.int64)
    places, tables, row, rows = [], [], np.zeros(len(first), np.int64), 0
    for k, (each, part) in enumerate(zip(splits, parts, strict=True)):
        own = np.flatnonzero((sources >= part.start) & (sources < part.stop))
        if each is None:
            corners, row[own] = np.unique(first[own], return_inverse=True)
            dim = 2 + (strides[0] > 0)
            steps = np.indices((3,) * dim).reshape(dim, -1).T @ np.array(strides[3 - dim :])
            tables.append(corners[:, None] + steps)
        else:
            row[own] = each.row[sources[own] - part.start]
            tables.append(begin[k] + each.table)
            places.append(begin[k] + each.place)
        row[own] += rows
        rows += len(tables[-1])
    return np.concatenate(places), np.concatenate(tables), row


def _in_units(block: Array) -> tuple[Array, list[tuple[int, int]], list[int]]:
    """Sort a body's particles by their blocks (N_b, D), and cut the order into units.

    Returns:
        The order (N_b,), the pieces of it that are units, and where the units of each of 8 colours begin (9,).
    """
    dim = block.shape[1]
    shape = block.max(axis=0) + 1
    number = np.ravel_multi_index(tuple(block.T), tuple(shape))
    colour = (block % 2) @ (2 ** np.arange(dim - 1, -1, -1))
    order = np.lexsort((number, colour))  # stable: within a block in the order of the particles
    new_block = np.flatnonzero(np.diff(number[order]) | np.diff(colour[order])) + 1
    ends = np.append(new_block, len(order))
    of_colour = colour[order][ends - 1]
    pieces, starts, first = [], [], 0
    for each in range(8):
        starts.append(len(pieces))
        for end in ends[of_colour == each]:
            if end - first >= UNIT:
                pieces.append((first, int(end)))
                first = int(end)
        last = int(ends[of_colour == each].max(initial=first))
        if last > first:
            pieces.append((first, last))
            first = last
    return order, pieces, [*starts, len(pieces)]

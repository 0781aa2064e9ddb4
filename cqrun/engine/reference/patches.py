"""The nodes of each body in the reference frame, and the order of its particles, which never change.

Each body has nodes of its own, those of the rest grid that its stencils reach: bodies do not feel each other through
the grid. So the grid of each body may be shifted by less than a cell (`Model.offset`). All bodies' nodes lie in one
array, with the same strides. A body's nodes fill a box as deep and wide as the largest of any body, so that an index
needs no table; boxes follow each other.

Particles are sorted once, by colour and block as in `blocks.py`. Consecutive blocks of a colour form units of at least
`UNIT` particles, each padded to whole lanes. Units of one colour share no node, so threads can take them in any order.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from cqrun.engine.blocks import BLOCK
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

    `first` (n,) and `f` (n, D) are the stencil of each column: its first node, and the particle's place in it [cells].
    `origin` (B, D) is the grid node, as in the world's grid, at the lower corner of each body's box, and `begin`
    (B + 1,) where a body's nodes begin. `units` (U, 2) are the columns of each unit, in the order of bodies and
    colours; `colours` (B, 9) is where the units of each body and colour begin.
    """

    layout: SortedLayout
    first: Array
    f: Array
    strides: tuple[int, int, int]
    box: Array  # (D,) nodes of a box along each axis but the first
    origin: Array
    begin: Array
    units: Array
    colours: Array
    offset: Array  # (B, D) of each body's grid from that of the world [m]

    @property
    def n_nodes(self) -> int:
        """Number of nodes in all boxes."""
        return int(self.begin[-1])

    def body_of_nodes(self) -> Array:
        """Return the body of each node (M,)."""
        return np.repeat(np.arange(len(self.origin)), np.diff(self.begin))

    def positions(self, dx: float) -> Array:
        """Return the position of each node at rest (M, D) [m]."""
        pieces = []
        for body, origin in enumerate(self.origin):
            shape = (int(self.begin[body + 1] - self.begin[body]) // int(np.prod(self.box[1:])), *self.box[1:])
            axes = [np.arange(count) + first - MARGIN for count, first in zip(shape, origin, strict=True)]
            grid = np.meshgrid(*axes, indexing="ij")
            pieces.append(np.stack(grid, axis=-1).reshape(-1, len(origin)) * dx + self.offset[body])
        return np.concatenate(pieces)


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


def make_patches(layout: Layout, x: Array, dx: float, offset: Array | None = None) -> Patches:
    """Return the nodes and the order of particles at rest.

    Args:
        x: positions (N, D) [m], in user order.
        offset: of each body's grid from that of the world (B, D) [m]; 0 if absent.
    """
    dim = layout.dim
    cells = _in_cells(layout, x, dx, offset)
    base = np.floor(cells - 0.5).astype(np.int64)
    parts = layout.slices()
    origin, extent = _boxes(layout, base)
    box = extent.max(axis=0)
    inner = np.append(np.cumprod(box[:0:-1])[::-1], 1)  # strides of row-major nodes
    strides = (0, *(int(s) for s in inner)) if dim == 2 else tuple(int(s) for s in inner)
    begin = np.concatenate([[0], np.cumsum(extent[:, 0] * int(np.prod(box[1:])))]).astype(np.int64)
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
    return Patches(
        sorted_layout, first, f, strides, box, origin, begin, np.array(units, np.int64),  # type: ignore[arg-type]
        np.array(colours, np.int64), np.zeros(origin.shape) if offset is None else offset,
    )  # fmt: skip


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

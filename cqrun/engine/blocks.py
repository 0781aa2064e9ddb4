"""Coloured blocks: the order in which particles scatter, and the blocks of nodes that may hold mass.

The grid is cut into blocks of 4^D cells; a particle belongs to the block of its stencil's first node. Blocks of one
colour (their parity along each axis) share no node, so threads scatter them in parallel without a race. Within a block
particles scatter in index order, so sums do not depend on the number of threads.

A particle may leave its block by one cell in each direction before two blocks of a colour share a node: stencils reach
nodes 4 b - 1 ... 4 b + 6, and the next block of the colour starts at 4 b + 7. So particles are sorted every
`SORT_EVERY` substeps, and earlier if the fastest could have moved by a cell. A rollout that is repeated from a multiple
of SORT_EVERY gives bit-for-bit identical results.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array

BLOCK = 4
"""Cells along a block's edge."""

SORT_EVERY = 8
"""Substeps between two sorts."""


class Blocks(NamedTuple):
    """Work lists, rebuilt by `sort_particles`; b is the number of blocks, in row-major order."""

    shape: Array  # (3,) blocks along the three loop axes; 1 first in 2D
    home: Array  # (n,) block of each particle
    order: Array  # (n,) particles in the order of the scatter: by colour, then block, then index
    start: Array  # (b + 1,) where the particles of each block of `work` begin in `order`
    cursor: Array  # (b,) scratch: number of particles of each block, then the place of its next one
    work: Array  # (b,) blocks with particles, by colour
    colour: Array  # (9,) where each of the 8 colours begins in `work`
    nodes: Array  # (b,) blocks whose nodes may hold mass
    n_nodes: Array  # (1,) number of entries of `nodes` in use
    marked: Array  # (b,) scratch: 1 for blocks in `nodes`
    travel: Array  # (1,) largest possible distance of a particle from its place at the last sort, in cells


def make_blocks(shape: tuple[int, int, int], n: int) -> Blocks:
    """Return empty work lists for a grid of `shape` blocks and n particle columns."""
    b, ints = int(np.prod(shape)), np.int64
    return Blocks(
        np.array(shape, ints), np.zeros(n, ints), np.zeros(n, ints), np.zeros(b + 1, ints), np.zeros(b, ints),
        np.zeros(b, ints), np.zeros(9, ints), np.zeros(b, ints), np.zeros(1, ints), np.zeros(b, ints), np.zeros(1),
    )  # fmt: skip


@kernel
def sort_particles(blocks: Blocks, place: Array) -> None:
    """Sort particles by block (a stable counting sort) and list the work; `place` (n, 4) in cells."""
    n = place.shape[0]
    ny, nz = blocks.shape[1], blocks.shape[2]
    home, cursor = blocks.home, blocks.cursor
    cursor[:] = 0
    for p in range(n):
        i = int(place[p, 0] - 0.5) // BLOCK
        j = int(place[p, 1] - 0.5) // BLOCK
        k = int(place[p, 2] - 0.5) // BLOCK
        block = (i * ny + j) * nz + k
        home[p] = block
        cursor[block] += 1
    _list_work(blocks)
    for p in range(n):
        blocks.order[cursor[home[p]]] = p
        cursor[home[p]] += 1
    _list_nodes(blocks)
    blocks.travel[0] = 0.0


@kernel
def _list_work(blocks: Blocks) -> None:
    """List the blocks with particles, colour by colour, and set the place of each in `order`."""
    ny, nz = blocks.shape[1], blocks.shape[2]
    n_work = total = 0
    for colour in range(8):
        blocks.colour[colour] = n_work
        for i in range((colour >> 2) & 1, blocks.shape[0], 2):
            for j in range((colour >> 1) & 1, ny, 2):
                for k in range(colour & 1, nz, 2):
                    block = (i * ny + j) * nz + k
                    count = blocks.cursor[block]
                    if count > 0:
                        blocks.work[n_work], blocks.start[n_work] = block, total
                        blocks.cursor[block] = total
                        n_work += 1
                        total += count
    blocks.colour[8], blocks.start[n_work] = n_work, total


@kernel
def _list_nodes(blocks: Blocks) -> None:
    """List all blocks that a stencil may reach until the next sort: blocks with particles, and their neighbours."""
    nx, ny, nz = blocks.shape[0], blocks.shape[1], blocks.shape[2]
    for index in range(blocks.n_nodes[0]):
        blocks.marked[blocks.nodes[index]] = 0
    count = 0
    for index in range(blocks.colour[8]):
        block = blocks.work[index]
        i, j, k = block // (ny * nz), block // nz % ny, block % nz
        for a in range(max(i - 1, 0), min(i + 2, nx)):
            for c in range(max(j - 1, 0), min(j + 2, ny)):
                for d in range(max(k - 1, 0), min(k + 2, nz)):
                    near = (a * ny + c) * nz + d
                    if blocks.marked[near] == 0:
                        blocks.marked[near] = 1
                        blocks.nodes[count] = near
                        count += 1
    blocks.n_nodes[0] = count


@kernel
def first_node(blocks: Blocks, block: int, strides: Any) -> int:
    """Return the node at a block's lower corner."""
    ny, nz = blocks.shape[1], blocks.shape[2]
    i, j, k = block // (ny * nz), block // nz % ny, block % nz
    return (i * strides[0] + j * strides[1] + k) * BLOCK

"""Stencils: the 3^D nodes that a particle exchanges momentum with, from its position or known for ever.

A stencil begins at its first node, the one at its lower corner; the others follow by strides of the grid. Where nodes
are split (reference/split.py), it is a row of a table instead. All of this is decided by the type of what is given, so
kernels are compiled apart.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba.core import types
from numba.extending import overload

from cqrun.numerics.compile import kernel, own_symbols, written
from cqrun.numerics.lanes import floor, lane
from cqrun.numerics.records import load4, whole_lane
from cqrun.numerics.wide_records import load_neighbours, load_pairs, load_records, records_in_lane
from cqrun.plugin.contract import Array


class Stencils(NamedTuple):
    """The stencils of particles that never change: the first node of each (n,), and f as a record (n, 4)."""

    first: Array
    f: Array


class SplitStencils(NamedTuple):
    """Stencils whose nodes are in a table: where the 3^D of each particle begin (n,), and f. See reference/split.py."""

    first: Array
    f: Array
    table: Array


own_symbols(Stencils)
own_symbols(SplitStencils)

FIXED = (Stencils, SplitStencils)
"""Stencils that never change."""


def first_nodes(base: Any, strides: Any) -> Any:
    """Return the node number of each record (i, j, k, -) as a tuple."""
    i, j, k = (base[axis::4].astype(int) for axis in range(3))
    return tuple(i * strides[0] + j * strides[1] + k)


@overload(first_nodes)
def _first_nodes(base, strides):
    nodes = [
        f"int(lane(base, {at})) * strides[0] + int(lane(base, {at + 1})) * strides[1] + int(lane(base, {at + 2}))"
        for at in range(0, base.width, 4)
    ]
    return written(f"lambda base, strides: ({', '.join(nodes)},)", {"lane": lane})


@kernel
def stencil_at(place: Array, p: int, strides: Any) -> Any:
    """Return the first node of the stencil at a position, and f."""
    x = load4(place, p)
    base = floor(x - 0.5)
    return first_nodes(base, strides)[0], x - base


def stencil(place: Any, p: int, strides: Any) -> Any:
    """Return the first node of a particle's stencil, and f."""
    return (int(place.first[p]), place.f[p].copy()) if isinstance(place, FIXED) else stencil_at(place, p, strides)


def _never_changes(place: Any) -> bool:
    """Return whether a Numba type is that of stencils that never change."""
    return isinstance(place, types.NamedTuple) and place.instance_class in FIXED


def _has_table(place: Any) -> bool:
    """Return whether a Numba type is that of `SplitStencils`."""
    return isinstance(place, types.NamedTuple) and place.instance_class is SplitStencils


def node_of(place: Any, first: int, i: int, j: int, k: int, strides: Any) -> Any:
    """Return node (i, j, k) of the stencil that begins at `first`."""
    if isinstance(place, SplitStencils):
        return int(place.table[first + 9 * i + 3 * j + k])
    return first + i * strides[0] + j * strides[1] + k


@overload(node_of)
def _node_of(place, first, i, j, k, strides):
    if _has_table(place):
        return lambda place, first, i, j, k, strides: place.table[first + 9 * i + 3 * j + k]
    return lambda place, first, i, j, k, strides: first + i * strides[0] + j * strides[1] + k


def row_of(place: Any, first: int, i: int, j: int, strides: Any) -> Any:
    """Return the three nodes (i, j, 0 .. 2) of the stencil that begins at `first`."""
    return tuple(node_of(place, first, i, j, k, strides) for k in range(3))


@overload(row_of)
def _row_of(place, first, i, j, strides):
    if _has_table(place):
        return written(
            "lambda place, first, i, j, strides: ("
            + "".join(f"place.table[first + 9 * i + 3 * j + {k}], " for k in range(3))
            + ")"
        )

    def nodes(place, first, i, j, strides):
        node = first + i * strides[0] + j * strides[1]
        return node, node + 1, node + 2

    return nodes


def records_at(grid: Array, place: Any, nodes: Any, i: int, j: int, k: int, strides: Any) -> Any:
    """Return the records of nodes (i, j, k) of the stencils that begin at `nodes`, in one lane value."""
    return load_records(grid, tuple(node_of(place, first, i, j, k, strides) for first in nodes), 0)


@overload(records_at)
def _records_at(grid, place, nodes, i, j, k, strides):
    if not _has_table(place):
        return lambda grid, place, nodes, i, j, k, strides: load_records(
            grid, nodes, i * strides[0] + j * strides[1] + k
        )
    return written(_by_table("load_records", len(nodes)), {"load_records": load_records})


def pairs_at(pairs: Array, place: Any, nodes: Any, i: int, j: int, k: int, strides: Any) -> Any:
    """Return the first and the second records of pairs at nodes (i, j, k) of the stencils that begin at `nodes`."""
    return load_pairs(pairs, tuple(node_of(place, first, i, j, k, strides) for first in nodes), 0)


@overload(pairs_at)
def _pairs_at(pairs, place, nodes, i, j, k, strides):
    if not _has_table(place):
        return lambda pairs, place, nodes, i, j, k, strides: load_pairs(
            pairs, nodes, i * strides[0] + j * strides[1] + k
        )
    return written(_by_table("load_pairs", len(nodes)).replace("grid", "pairs"), {"load_pairs": load_pairs})


def _by_table(load: str, count: int) -> str:
    """Return the source of a load of the nodes that a table gives."""
    nodes = ", ".join(f"place.table[nodes[{n}] + 9 * i + 3 * j + k]" for n in range(count))
    return f"lambda grid, place, nodes, i, j, k, strides: {load}(grid, ({nodes},), 0)"


@overload(stencil)
def _stencil(place, p, strides):
    if _never_changes(place):
        return lambda place, p, strides: (place.first[p], load4(place.f, p))
    return lambda place, p, strides: stencil_at(place, p, strides)


@kernel
def stencils_at(place: Array, p: int, strides: Any) -> Any:
    """Return the first nodes of the stencils at the positions of particles p, p + 1, ... of a lane value, and f's."""
    x = load_neighbours(place, p)
    base = floor(x - 0.5)
    return first_nodes(base, strides), x - base


def stencils(place: Any, p: int, strides: Any) -> Any:
    """Return the first nodes of the stencils of particles p, p + 1, ... of a lane value, and their f's."""
    if not isinstance(place, FIXED):
        return stencils_at(place, p, strides)
    return tuple(place.first[p : p + records_in_lane(place.f)]), load_neighbours(place.f, p)


@overload(stencils)
def _stencils(place, p, strides):
    if not _never_changes(place):
        return lambda place, p, strides: stencils_at(place, p, strides)
    per_value = whole_lane(place.types[place.fields.index("f")].dtype).width // 4
    first = ", ".join(f"place.first[p + {k}]" for k in range(per_value))
    return written(
        f"lambda place, p, strides: (({first},), load_neighbours(place.f, p))", {"load_neighbours": load_neighbours}
    )

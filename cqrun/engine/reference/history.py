"""Histories of materials: numbers of the particles that a substep changes, in rows of a state.

A state has them in rows after those of nodes and springs. A row is 4 numbers in each half of a state: those of 8
neighbouring columns. While substeps run, `NodeRun.q` has the values, and in the adjoint `NodeBars.q` has their
cotangents: the sweep (`sweep.py`) turns those at a substep's beginning into those at its end, and back.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.engine.arrays import get_columns
from cqrun.engine.model import Model
from cqrun.engine.reference.fields import put_linear
from cqrun.engine.reference.setting import TILE, NodeBars, NodeRun
from cqrun.engine.reference.shape import place_history
from cqrun.engine.setting import Crew, Group
from cqrun.engine.transfer import gather, scatter_tile
from cqrun.materials.history import settle_histories, settle_histories_vjp
from cqrun.materials.term import has_history, zeros_like_rows
from cqrun.numerics.compile import barrier, for_each, kernel, one_body, own_symbols, share
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.numerics.packed import pack, unpack
from cqrun.numerics.tensor import plus_diagonal, scale
from cqrun.plugin.contract import Array

COLUMNS = 8
"""Columns whose numbers make a row of a state: 4 in each half."""


class Histories(NamedTuple):
    """Where the histories are, and the groups that have one, each with its first body and the one after its last.

    In the adjoint, each group has its cotangent beside it.
    """

    parts: tuple[Any, ...]
    first: int  # their first row in `NodeRun.q`
    begin: int  # their first row in a state


own_symbols(Histories)


def make_histories(model: Model, groups: tuple[Group, ...], begin: int) -> tuple[Histories, ...]:
    """Return the histories of a model whose rows begin at `begin` in a state, or none."""
    if not model.layout.history:
        return ()
    parts = (
        (kernel, group.bodies[0], group.bodies[-1] + 1)
        for kernel, group in zip(groups, model.groups, strict=True)
        if remembers(kernel)
    )
    return (Histories(tuple(parts), model.layout.table.rows["F"].stop, begin),)


def remembers(group: Group) -> bool:
    """Return whether a term of a group has a history."""
    return any(has_history(type(term)) for term in group.terms)


def with_bars(
    histories: tuple[Histories, ...], groups: tuple[Group, ...], groups_bar: tuple[Group, ...]
) -> tuple[Histories, ...]:
    """Return histories whose groups have their cotangents beside them."""
    pairs = [pair for pair in zip(groups, groups_bar, strict=True) if remembers(pair[0])]
    return tuple(
        each._replace(parts=tuple((pair, *bodies) for pair, (_, *bodies) in zip(pairs, each.parts, strict=True)))
        for each in histories
    )


# --- between a state and the particles' table -------------------------------------------------------------------------


def rows_of_state(q: Array, first: int) -> Array:
    """Return the rows of a state (2, H, 4) for the histories in a packed table q, whose rows begin at `first`."""
    h = unpack(q)[first:]
    blocks = h.reshape(len(h), -1, 2, COLUMNS // 2)
    return blocks.transpose(2, 1, 0, 3).reshape(2, -1, COLUMNS // 2)


def rows_of_table(rows: Array, count: int) -> Array:
    """Return `count` numbers of each column (count, n) for the rows of a state (2, H, 4)."""
    blocks = rows.reshape(2, -1, count, COLUMNS // 2)
    return blocks.transpose(2, 1, 0, 3).reshape(count, -1)


def put_histories(histories: tuple[Histories, ...], q: Array, state: Array) -> None:
    """Write the histories of a state to a packed table q."""
    for each in histories:
        q[:, each.first :] = pack(rows_of_table(state[:, each.begin :], q.shape[1] - each.first), q.dtype)


@kernel
def recall(histories: Histories, run: NodeRun, q: Array, u: Array, v: Array, crew: Crew) -> None:
    """Write the histories of the state (u, v) to q."""
    width, first, half = q.shape[2], histories.first, COLUMNS // 2
    count = q.shape[1] - first
    lo, hi = share(q.shape[0] * width // COLUMNS, crew.thread, crew.n_threads)
    for block in range(lo, hi):
        for row in range(count):
            at = histories.begin + block * count + row
            for k in range(half):
                p = block * COLUMNS + k
                q[p // width, first + row, p % width] = u[at, k]
                q[(p + half) // width, first + row, (p + half) % width] = v[at, k]
    barrier(run.arrivals, crew.n_threads)


@kernel
def keep(histories: Histories, run: NodeRun, q: Array, u: Array, v: Array, crew: Crew) -> None:
    """Write the histories in q to the state (u, v)."""
    width, first, half = q.shape[2], histories.first, COLUMNS // 2
    count = q.shape[1] - first
    lo, hi = share(q.shape[0] * width // COLUMNS, crew.thread, crew.n_threads)
    for block in range(lo, hi):
        for row in range(count):
            at = histories.begin + block * count + row
            for k in range(half):
                p = block * COLUMNS + k
                u[at, k] = q[p // width, first + row, p % width]
                v[at, k] = q[(p + half) // width, first + row, (p + half) % width]
    barrier(run.arrivals, crew.n_threads)


recall_each, keep_each = for_each(recall), for_each(keep)


# --- after a long rest ------------------------------------------------------------------------------------------------


@kernel
def settle_part(part: tuple[Group, int, int], run: NodeRun, u: Array, colours: Array) -> None:
    """Write the histories that a group has where it has rested at u for long to `run.q`."""
    group, first, last = part
    value, moment, setting = run.tiles.value[0], run.tiles.moment[0], run.setting
    for unit in range(colours[first, 0], colours[last - 1, 8]):
        for tile in range(run.units[unit, 0], run.units[unit, 1], TILE):
            end = min(tile + TILE, run.units[unit, 1])
            gather(u, run.stencils, value, moment, tile, end, setting.strides, setting.dims)
            settle_tile(group, run, moment, tile, end)


@one_body
def settle_tile(group: Group, run: NodeRun, moment: Array, tile: int, end: int) -> None:
    """Write the histories of the particles tile .. end, from the moments of the displacement."""
    dims, factor, width = run.setting.dims, 4.0 / run.setting.dx, LANE_BYTES // run.q.itemsize
    for i in range(tile, end, width):
        F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
        settle_histories(group.terms, run.q, i, F, run.setting.dt)


@kernel
def settle_part_vjp(
    part: tuple[tuple[Group, Group], int, int], run: NodeRun, bars: NodeBars, u: Array, colours: Array
) -> None:
    """Add the adjoint of `settle_part`, from the cotangents in `bars.q`, to those of u and of the parameters."""
    groups, first, last = part
    setting, stencils, tiles, width = run.setting, run.stencils, run.tiles, LANE_BYTES // run.q.itemsize
    value, moment, dims, factor = tiles.value[0], tiles.moment[0], setting.dims, 4.0 / setting.dx
    for unit in range(colours[first, 0], colours[last - 1, 8]):
        for tile in range(run.units[unit, 0], run.units[unit, 1], TILE):
            end = min(tile + TILE, run.units[unit, 1])
            gather(u, stencils, value, moment, tile, end, setting.strides, dims)
            for i in range(tile, end, width):
                F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
                zero = zeros_like_rows(F)
                F_bar = settle_histories_vjp(groups[0].terms, groups[1].terms, bars.q, i, F, setting.dt, zero)
                put_linear(value, moment, stencils, i, i - tile, scale(F_bar, factor), dims)
            place_history(bars.shape, run, u, tile, end, 0)
            scatter_tile(bars.u, (value,), (moment,), stencils, tile, end, setting.strides, dims)


settle_each, settle_each_vjp = for_each(settle_part), for_each(settle_part_vjp)


@kernel
def settle(histories: Histories, run: NodeRun, u: Array, colours: Array) -> None:
    """Write the histories that bodies have where they have rested at u for long to `run.q`, on one thread."""
    settle_each(histories.parts, run, u, colours)


@kernel
def settle_vjp(histories: Histories, run: NodeRun, bars: NodeBars, u: Array, colours: Array) -> None:
    """Run the adjoint of `settle`, on one thread."""
    settle_each_vjp(histories.parts, run, bars, u, colours)

"""Histories of materials: numbers of the particles that a substep changes after the nodes have moved; the adjoint.

A state has them in rows after those of nodes and springs. A row is 4 numbers in each half of a state: those of 8
neighbouring columns. While substeps run, `NodeRun.q` has the values, and in the adjoint `NodeBars.q` has their
cotangents. A substep's stress depends on h at its beginning, and `update` (materials/term.py) gives h at its end:

    tau = tau(F, h),   h' = update(F', h)   with F of u and F' of u'.

The next substep's sweep gathers F' in any case, so it does the update (`sweep.py`). Only where h' is wanted at once, at
the end of a control step, `remember` does it, with a gather of its own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba.extending import overload

from cqrun.engine.arrays import get_columns
from cqrun.engine.model import Model
from cqrun.engine.reference.fields import put_linear
from cqrun.engine.reference.setting import TILE, NodeBars, NodeRun, NodeStep
from cqrun.engine.reference.shape import place_history
from cqrun.engine.setting import Crew, Group
from cqrun.engine.transfer import gather, scatter_tile
from cqrun.materials.history import update_histories, update_histories_vjp
from cqrun.materials.term import has_history, is_updated, zeros_like_rows
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


# --- a substep --------------------------------------------------------------------------------------------------------


@kernel
def follow(part: tuple[Group, int, int], run: NodeRun, u_next: Array, colours: Array, crew: Crew) -> None:
    """Update a group's histories in `run.q`."""
    group, first, last = part
    begin, end = colours[first, 0], colours[last - 1, 8]
    lo, hi = share(end - begin, crew.thread, crew.n_threads)
    for unit in range(begin + lo, begin + hi):
        follow_unit(group, run, u_next, run.units[unit, 0], run.units[unit, 1], crew.thread)


@kernel
def follow_unit(group: Group, run: NodeRun, u_next: Array, lo: int, hi: int, thread: int) -> None:
    """Update the histories of the particles lo .. hi."""
    value, moment = run.tiles.value[thread], run.tiles.moment[thread]
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(u_next, run.stencils, value, moment, tile, end, run.setting.strides, run.setting.dims)
        update_tile(group, run, moment, tile, end)


@one_body
def update_tile(group: Group, run: NodeRun, moment: Array, tile: int, end: int) -> None:
    """Update the histories of the particles tile .. end, from the moments of the displacement."""
    dims, factor, width = run.setting.dims, 4.0 / run.setting.dx, LANE_BYTES // run.q.itemsize
    for i in range(tile, end, width):
        F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
        update_histories(group.terms, run.q, run.q, i, F, run.setting.dt)


def catch_up(group: Any, means: Any, run: NodeRun, u: Array, tile: int, end: int, thread: int) -> None:
    """Update the histories of a tile whose moments of u are there, unless volumes are averaged."""
    if remembers(group):
        value, moment = run.tiles.value[thread], run.tiles.moment[thread]
        if len(means) > 0:
            gather(u, run.stencils, value, moment, tile, end, run.setting.strides, run.setting.dims)
        update_tile(group, run, moment, tile, end)


@overload(catch_up)
def _catch_up(group, means, run, u, tile, end, thread):
    terms = group.types[group.fields.index("terms")]
    if not any(is_updated(term.instance_class) for term in terms):
        return lambda group, means, run, u, tile, end, thread: None

    def known(group, means, run, u, tile, end, thread):
        update_tile(group, run, run.tiles.moment[thread], tile, end)

    def gathered(group, means, run, u, tile, end, thread):
        value, moment = run.tiles.value[thread], run.tiles.moment[thread]
        gather(u, run.stencils, value, moment, tile, end, run.setting.strides, run.setting.dims)
        update_tile(group, run, moment, tile, end)

    return gathered if len(means) else known


@kernel
def follow_vjp(
    part: tuple[tuple[Group, Group], int, int], run: NodeRun, bars: NodeBars, u_next: Array, colours: Array, crew: Crew
) -> None:
    """Turn the cotangents of a group's histories after a substep into those before it, and add to those of u_next."""
    groups, first, last = part
    for body in range(first, last):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    follow_unit_vjp(groups, run, bars, u_next, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)


@kernel
def follow_unit_vjp(
    groups: tuple[Group, Group], run: NodeRun, bars: NodeBars, u_next: Array, lo: int, hi: int, thread: int
) -> None:
    """Run the adjoint of `follow_unit`."""
    group, group_bar = groups
    setting, stencils, tiles, width = run.setting, run.stencils, run.tiles, LANE_BYTES // run.q.itemsize
    value, moment, dims, factor = tiles.value[thread], tiles.moment[thread], setting.dims, 4.0 / setting.dx
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(u_next, stencils, value, moment, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
            F_bar = update_histories_vjp(
                group.terms, group_bar.terms, run.q, bars.q, i, F, setting.dt, zeros_like_rows(F)
            )
            put_linear(value, moment, stencils, i, i - tile, scale(F_bar, factor), dims)
        place_history(bars.shape, run, u_next, tile, end, thread)
        scatter_tile(bars.u, (value,), (moment,), stencils, tile, end, setting.strides, dims)


follow_each, follow_each_vjp = for_each(follow), for_each(follow_vjp)


@kernel
def remember(histories: Histories, run: NodeRun, u_next: Array, v_next: Array, colours: Array, crew: Crew) -> None:
    """Update all histories after a substep, and write them to the state after it."""
    follow_each(histories.parts, run, u_next, colours, crew)
    barrier(run.arrivals, crew.n_threads)
    keep(histories, run, run.q, u_next, v_next, crew)


@kernel
def remember_vjp(
    histories: Histories, run: NodeRun, bars: NodeBars, at: NodeStep, u_next: Array, colours: Array, crew: Crew
) -> None:
    """Run the adjoint of `remember`, after it has written the histories before the substep to `run.q`."""
    recall(histories, run, run.q, at.u, at.v, crew)
    follow_each_vjp(histories.parts, run, bars, u_next, colours, crew)


remember_each, remember_each_vjp = for_each(remember), for_each(remember_vjp)

"""Passes over the nodes that may hold mass: clear, velocity and boundaries, and their adjoint.

    v_n = mv_n / m_n,   v_n <- each boundary condition of the node, in order

The velocity replaces momentum and mass. The adjoint has a second record for each node (`Work.both`). The particles'
momentum already contains gravity and other forces. Each thread takes whole blocks of nodes.
"""

from __future__ import annotations

from typing import Any

from cqrun.boundaries.condition import project_all, project_all_vjp
from cqrun.engine.arrays import components, record_of
from cqrun.engine.blocks import BLOCK, first_node
from cqrun.engine.setting import Crew
from cqrun.engine.updated.setting import Run
from cqrun.numerics.compile import kernel, share
from cqrun.numerics.lanes import lane, with_lane
from cqrun.numerics.records import load4, store4
from cqrun.plugin.contract import Array


@kernel
def clear(grid: Array, records: int, run: Run, crew: Crew) -> None:
    """Set the nodes that may hold mass to zero, in a grid with this number of records per node."""
    setting, work = run.setting, run.work
    lo, hi = share(work.blocks.n_nodes[0], crew.thread, crew.n_threads)
    strides = setting.strides
    for index in range(lo, hi):
        first = first_node(work.blocks, work.blocks.nodes[index], strides)
        for i in range(BLOCK if len(setting.dims) == 3 else 1):
            for j in range(BLOCK):
                node = first + i * strides[0] + j * strides[1]
                for k in range(node * records, (node + BLOCK) * records):
                    store4(grid, k, 0.0)


@kernel
def update_grid(conditions: Any, run: Run, crew: Crew) -> None:
    """Turn momentum and mass into velocity."""
    setting, work = run.setting, run.work
    lo, hi = share(work.blocks.n_nodes[0], crew.thread, crew.n_threads)
    strides = setting.strides
    for index in range(lo, hi):
        first = first_node(work.blocks, work.blocks.nodes[index], strides)
        for i in range(BLOCK if len(setting.dims) == 3 else 1):
            for j in range(BLOCK):
                for k in range(BLOCK):
                    node = first + i * strides[0] + j * strides[1] + k
                    mv = load4(work.grid, node)
                    m = lane(mv, 3)
                    if m > 0.0:
                        v = mv / m
                        bits = work.condition_bits[node]
                        if bits != 0:
                            after = project_all(conditions, node, bits, components(v, setting.dims))
                            v = record_of(0.0, work.grid, after)
                        store4(work.grid, node, v)
                    else:
                        store4(work.grid, node, 0.0)


@kernel
def update_grid_vjp(conditions: Any, run: Run, crew: Crew) -> None:
    """Turn momentum and mass into velocity, and the cotangent of velocity into theirs."""
    setting, work = run.setting, run.work
    lo, hi = share(work.blocks.n_nodes[0], crew.thread, crew.n_threads)
    strides = setting.strides
    for index in range(lo, hi):
        first = first_node(work.blocks, work.blocks.nodes[index], strides)
        sums = index * len(conditions)
        for k in range(len(conditions)):
            work.friction_bar[sums + k] = 0.0
        for i in range(BLOCK if len(setting.dims) == 3 else 1):
            for j in range(BLOCK):
                for k in range(BLOCK):
                    node = first + i * strides[0] + j * strides[1] + k
                    mv = load4(work.both, 2 * node)
                    m = lane(mv, 3)
                    if m > 0.0:
                        v, v_bar = mv / m, load4(work.both, 2 * node + 1)
                        bits = work.condition_bits[node]
                        if bits != 0:
                            before, after_bar = components(v, setting.dims), components(v_bar, setting.dims)
                            after = project_all(conditions, node, bits, before)
                            before_bar = project_all_vjp(
                                conditions, node, bits, before, after_bar, work.friction_bar, sums
                            )
                            v, v_bar = record_of(0.0, work.both, after), record_of(0.0, work.both, before_bar)
                        mv_bar = v_bar / m
                        flow = mv_bar * mv / m
                        m_bar = -(lane(flow, 0) + lane(flow, 1) + lane(flow, 2))
                        store4(work.both, 2 * node, v)
                        store4(work.both, 2 * node + 1, with_lane(mv_bar, 3, m_bar))
                    else:
                        store4(work.both, 2 * node, 0.0)
                        store4(work.both, 2 * node + 1, 0.0)


@kernel
def add_friction_bar(coefficient_bar: Array, run: Run, crew: Crew) -> None:
    """Add the blocks' partial sums in block order, on one thread."""
    work = run.work
    if crew.thread == 0:
        for index in range(work.blocks.n_nodes[0]):
            for k in range(len(coefficient_bar)):
                coefficient_bar[k] += work.friction_bar[index * len(coefficient_bar) + k]

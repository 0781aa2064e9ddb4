"""External forces on the nodes, constant in a control step: f_n = sum_p w (f_p + push_p), and the adjoint."""

from __future__ import annotations

from cqrun.engine.arrays import add_vector, get_vector, load_F, load_vector
from cqrun.engine.reference.fields import put_affine
from cqrun.engine.reference.setting import TILE, NodeBars, NodeRun
from cqrun.engine.reference.shape import place_pushes
from cqrun.engine.setting import Crew
from cqrun.engine.transfer import gather, scatter_tile
from cqrun.numerics.compile import barrier, kernel, share
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.numerics.records import store4
from cqrun.numerics.tensor import add, scale
from cqrun.plugin.contract import Array
from cqrun.state import FORCE


@kernel
def clear_nodes(a: Array, run: NodeRun, crew: Crew) -> None:
    """Set the records (M, 4) of all active nodes to zero."""
    lo, hi = share(len(run.nodes.active), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        store4(a, run.nodes.active[index], 0.0)
    barrier(run.arrivals, crew.n_threads)


@kernel
def spread_forces(run: NodeRun, colours: Array, crew: Crew) -> None:
    """Set `run.outside` to the external forces; `colours` (B, 9) is where the units of bodies and colours begin."""
    clear_nodes(run.outside, run, crew)
    for body in range(colours.shape[0]):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    spread_unit(run, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)


@kernel
def spread_unit(run: NodeRun, lo: int, hi: int, thread: int) -> None:
    """Add the external forces of the particles lo .. hi."""
    setting, fields, push = run.setting, run.fields, run.push
    dims, width, pushed = setting.dims, LANE_BYTES // run.fields.itemsize, run.push.shape[0] > 0
    value, affine = run.tiles.value[thread], run.tiles.moment[thread]
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        for i in range(tile, end, width):
            no_gradient = scale(load_F(run.q, i, dims), 0.0)
            f = load_vector(fields, FORCE, i, dims)
            if pushed:
                f = add(f, load_vector(push, 0, i, dims))
            put_affine(value, affine, run.stencils, i, i - tile, no_gradient, f, dims)
        scatter_tile(run.outside, (value,), (affine,), run.stencils, tile, end, setting.strides, dims)


@kernel
def spread_forces_vjp(run: NodeRun, bars: NodeBars, crew: Crew) -> None:
    """Add the adjoint at bars.outside to the cotangents of the external and the steady forces; clear it."""
    lo, hi = share(len(run.units), crew.thread, crew.n_threads)
    setting, steady = run.setting, bars.steady.shape[0] > 0
    dims, width, thread = setting.dims, LANE_BYTES // run.fields.itemsize, crew.thread
    value, moment = run.tiles.value[thread], run.tiles.moment[thread]
    for unit in range(lo, hi):
        for tile in range(run.units[unit, 0], run.units[unit, 1], TILE):
            end = min(tile + TILE, run.units[unit, 1])
            gather(bars.outside, run.stencils, value, moment, tile, end, setting.strides, dims)
            for i in range(tile, end, width):
                f_bar = get_vector(value, i - tile, dims)
                add_vector(bars.fields, FORCE, i, f_bar, dims)
                if steady:
                    add_vector(bars.steady, 0, i, f_bar, dims)
            place_pushes(bars.shape, run, bars.outside, tile, end, thread)
    barrier(run.arrivals, crew.n_threads)
    clear_nodes(bars.outside, run, crew)

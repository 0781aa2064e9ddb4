"""The cotangent of the rest positions X: every weight, arm and hat depends on them, through the place in the stencil.

Each transfer of a particle is a sum T = sum_n w_n(f) g_n . (a + B (o_n - f)): g_n are numbers of nodes, and the affine
field is what the particle scatters, or the cotangent of what it gathers. So dT/df is the same for both, and needs the
fields that the adjoint has anyway:

    stress     u . (F_bar),   p . (-4/dx vol0 P),   and with rates v . (cotangent of F')
    history    u' . (cotangent of F after the substep)
    forces     p . (f_p + push),   summed over a control step
    looks      u . (x_bar, F_bar),   v . (v_bar, cotangent of F')
    start      mass_bar, kept_bar . (m, kappa m),   (v_bar / m) . (m v, m C dx)

X = dx f + (a node), so X_bar = f_bar / dx, and x_bar is added where a displacement is counted from X itself. Points of
cables and springs sum the cotangents of their weights. Quadratic weights have continuous slopes where a particle
crosses into another cell, hats (`volume.py`) have not: there the gradient is that of the side on which the particle is.

All this costs one more gather for each transfer. It is compiled only where this cotangent is wanted (`Inputs.shaped`):
otherwise `NodeBars.shape` is empty.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.engine.arrays import add_vector, load_F, load_matrix, load_vector, load_x
from cqrun.engine.reference.fields import put_affine, put_linear
from cqrun.engine.reference.points import riding_points_vjp
from cqrun.engine.reference.setting import TILE, NodeRun, NodeStep, Points, ShapeBars
from cqrun.engine.reference.volume import Means, MeansBars
from cqrun.engine.setting import Crew
from cqrun.engine.stencils import Stencils, node_of
from cqrun.engine.transfer import gather_slopes
from cqrun.forces.pulled import Pulled
from cqrun.numerics.compile import for_each, kernel, share
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.numerics.packed import aligned, load, pack, store, unpack
from cqrun.numerics.tensor import add, cofactor, det, inner, scale
from cqrun.plugin.contract import Array
from cqrun.state import FORCE, VOLUME


def make_shape_bars(rollout: Any) -> tuple[ShapeBars, ...]:
    """Return zero cotangents of the rest positions of a rollout, or none if they are not wanted."""
    if not rollout.inputs.shaped:
        return ()
    model, n, real = rollout.model, rollout.model.layout.n, rollout.model.real
    count = sum(len(load.rest) for load in rollout.loads)
    tiles = (aligned((rollout.threads, rows * TILE, 4), real) for rows in (1, 3))
    return (
        ShapeBars(
            aligned((n, 4), real), pack(np.zeros((model.dim, n)), real), np.zeros((count, model.dim)),
            np.zeros((count, 3**model.dim)), *tiles,
        ),
    )  # fmt: skip


def motion_bar(rollout: Any, shape: ShapeBars) -> Array:
    """Return the cotangent of the rest positions (N, D) that the substeps and looks have summed."""
    model, patches = rollout.model, rollout.rest.patches
    columns = model.layout.columns()
    bar = shape.place[columns, 3 - model.dim : 3] / model.dx + unpack(shape.rest)[:, columns].T
    for each in rollout.loads:
        x_bar, X_bar = riding_points_vjp(
            patches, rollout.rest.x, each.particle, each.rest, model.dx, shape.point_weight
        )
        bar += X_bar
        rides = each.particle >= 0
        np.add.at(bar, each.particle[rides], (x_bar + shape.point_rest)[rides])
    return np.asarray(bar, np.float64)


# --- stresses ---------------------------------------------------------------------------------------------------------


@kernel
def keep_one_force(shape: ShapeBars, run: NodeRun, A: Any, i: int, at: int, thread: int) -> None:
    """Write the affine field of the lane's internal forces to a tile."""
    put_linear(shape.value[thread], shape.affine[thread], run.stencils, i, at, A, run.setting.dims)


@kernel
def place_tile_stress(
    shape: ShapeBars, means: Any, run: NodeRun, pairs: Array, v: Array, tile: int, end: int, thread: int
) -> None:
    """Add what the stress of a tile depends on by the particles' places; the tiles have its fields.

    Args:
        pairs: at each node the displacement and the cotangent of its force.
    """
    tiles, stencils, strides, dims = run.tiles, run.stencils, run.setting.strides, run.setting.dims
    value, moment = tiles.value[thread], tiles.moment[thread]
    gather_slopes(shape.place, pairs, 2, 0, value, moment, stencils, tile, end, strides, dims)
    value, moment = shape.value[thread], shape.affine[thread]
    gather_slopes(shape.place, pairs, 2, 1, value, moment, stencils, tile, end, strides, dims)
    if run.setting.rates:
        value, moment = tiles.value_2[thread], tiles.moment_2[thread]
        gather_slopes(shape.place, v, 1, 0, value, moment, stencils, tile, end, strides, dims)
    place_hats(means, shape, run, tile, end, thread)


@kernel
def place_one_hats(
    pair: tuple[Means, MeansBars], shape: ShapeBars, run: NodeRun, tile: int, end: int, thread: int
) -> None:
    """Add what mean volumes depend on by the particles' hats.

    J_c = 1 + sum_p N_cp vol0_p (J_p - 1) / V_c and p_p = sum_c N_cp U'(J_c), so with pbar and b as in `volume.py`

        N_bar_cp = pbar_p U'(J_c) + vol0_p (J_p - 1) b_c - vol0_p b_c (J_c - 1).
    """
    means, bars = pair
    dims, width = run.setting.dims, LANE_BYTES // run.fields.itemsize
    by_slope, by_ratio, by_product = means.at, bars.at, bars.at_2
    for i in range(tile, end, width):
        F, Q, vol = load_F(run.q, i, dims), load_matrix(bars.slopes, i, dims), load(run.fields, VOLUME, i)
        store(by_slope.lanes[thread], 0, i - tile, inner(Q, cofactor(F)) * (vol * -1.0))
        store(by_ratio.lanes[thread], 0, i - tile, vol * (det(F) - 1.0))
        store(by_product.lanes[thread], 0, i - tile, vol * -1.0)
    for p in range(tile, end):
        numbers = by_slope.each[thread, p - tile], by_ratio.each[thread, p - tile], by_product.each[thread, p - tile]
        add_hat_slopes(shape.place, pair, run.stencils, run.setting.strides, dims, p, numbers)


@kernel
def add_hat_slopes(
    place: Array, pair: tuple[Means, MeansBars], stencils: Stencils, strides: Any, dims: Any, p: int, numbers: Any
) -> None:
    """Add the derivative by a particle's place of sum_c N_c (the numbers times U', b and b (J - 1) of the corner)."""
    means, bars = pair
    ways, first = len(dims) - 1, stencils.first[p]
    x, y, z = stencils.f[p, 0] - 0.5, stencils.f[p, 1] - 0.5, stencils.f[p, 2] - 0.5
    for i in range(ways):
        of_x, slope_x = (abs(1.0 - i - x), 2.0 * i - 1.0) if ways == 2 else (1.0, 0.0)
        for j in range(2):
            of_y, slope_y, low, high = abs(1.0 - j - y), 2.0 * j - 1.0, 0.0, 0.0
            at = node_of(stencils, first, i, j, 0, strides) - means.begin
            above = node_of(stencils, first, i, j, 1, strides) - means.begin
            for k, table in enumerate((means.pressure.each, bars.ratio.each, bars.product.each)):
                low += numbers[k] * table[at]
                high += numbers[k] * table[above]
            middle = (1.0 - z) * low + z * high
            place[p, 0] += slope_x * of_y * middle
            place[p, 1] += of_x * slope_y * middle
            place[p, 2] += of_x * of_y * (high - low)


@kernel
def place_tile_history(shape: ShapeBars, run: NodeRun, u: Array, tile: int, end: int, thread: int) -> None:
    """Add what the histories of a tile depend on by F after a substep; the tile has the field of its cotangent."""
    value, moment, setting = run.tiles.value[thread], run.tiles.moment[thread], run.setting
    gather_slopes(shape.place, u, 1, 0, value, moment, run.stencils, tile, end, setting.strides, setting.dims)


# --- forces -----------------------------------------------------------------------------------------------------------


@kernel
def place_tile_pushes(shape: ShapeBars, run: NodeRun, outside_bar: Array, tile: int, end: int, thread: int) -> None:
    """Add what external forces depend on by the places of a tile, from their cotangent of a control step (M, 4)."""
    stencils, dims, width = run.stencils, run.setting.dims, LANE_BYTES // run.fields.itemsize
    value, affine = shape.value[thread], shape.affine[thread]
    for i in range(tile, end, width):
        f = load_vector(run.fields, FORCE, i, dims)
        if run.push.shape[0] > 0:
            f = add(f, load_vector(run.push, 0, i, dims))
        put_affine(value, affine, stencils, i, i - tile, scale(load_F(run.q, i, dims), 0.0), f, dims)
    gather_slopes(shape.place, outside_bar, 1, 0, value, affine, stencils, tile, end, run.setting.strides, dims)


@kernel
def place_all_pulls(
    shape: ShapeBars, points: Points, pulled: Pulled, run: NodeRun, pairs: Array, at: NodeStep, crew: Crew
) -> None:
    """Add the cotangents of points: x = X + sum w u, v = sum w v_n, f_n = w f; those of forces are in the shares."""
    shares, dim = pulled.shares, shape.point_rest.shape[1]
    lo, hi = share(len(points.node), crew.thread, crew.n_threads)
    for j in range(lo, hi):
        for index in range(pulled.begin[j], pulled.begin[j + 1]):
            s = pulled.order[index]
            for d in range(dim):
                shape.point_rest[j, d] += shares.x_bar[s, d]
                for k in range(points.node.shape[1]):
                    n = points.node[j, k]
                    total = shares.x_bar[s, d] * pairs[2 * n, d] + shares.force[s, d] * pairs[2 * n + 1, d]
                    if run.setting.rates:
                        total += shares.v_bar[s, d] * at.v[n, d]
                    shape.point_weight[j, k] += total


# --- what is seen -----------------------------------------------------------------------------------------------------


@kernel
def place_tile_looks(
    shape: ShapeBars, run: NodeRun, q_bar: Array, u: Array, v: Array, tile: int, end: int, thread: int
) -> None:
    """Add what is seen of a tile by the particles' places; the tiles have the fields of the cotangents."""
    tiles, stencils, strides, dims = run.tiles, run.stencils, run.setting.strides, run.setting.dims
    value, moment = tiles.value[thread], tiles.moment[thread]
    gather_slopes(shape.place, u, 1, 0, value, moment, stencils, tile, end, strides, dims)
    value, moment = tiles.value_2[thread], tiles.moment_2[thread]
    gather_slopes(shape.place, v, 1, 0, value, moment, stencils, tile, end, strides, dims)
    for i in range(tile, end, LANE_BYTES // q_bar.itemsize):
        add_vector(shape.rest, 0, i, load_x(q_bar, i, dims), dims)


keep_force, place_stress, place_hats = for_each(keep_one_force), for_each(place_tile_stress), for_each(place_one_hats)
place_history = for_each(place_tile_history)
place_pushes, place_pulls, place_looks = (
    for_each(place_tile_pushes), for_each(place_all_pulls), for_each(place_tile_looks),
)  # fmt: skip

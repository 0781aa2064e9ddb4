"""The ghost penalty: a little stiffness of the nodes around the surface, which particles hardly feel.

    energy = gamma mu dx^(D-2) / 2 sum over runs  fill (u_3 - 3 u_2 + 3 u_1 - u_0)^2

over runs of four nodes with mass along each axis, of which one has a fill (volume over dx^D) below CUT; `fill` is the
least of the four, so that the lightest node shortens no substep. It is zero for affine and quadratic displacements (E.
Burman, Ghost penalty, Comptes Rendus Mathematique 348 (2010)). Equilibrium needs it: without it nodes of almost empty
cells are free to move. In motion it changes a beam's frequency by less than 0.1 %, and keeps both at the same rest.

mu is the mean shear modulus of each body. A run's third difference is found first; then each node sums those of its
runs in a fixed order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.nodes import product
from cqrun.engine.reference.patches import Patches
from cqrun.engine.reference.setting import NodeBars, NodeRun
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, for_each, kernel, own_symbols, share
from cqrun.numerics.packed import aligned
from cqrun.numerics.records import load4, store4
from cqrun.plugin.contract import Array

GAMMA = 1e-3
"""Weight of the penalty; ten times as much stiffens a beam of three cells by 2 %."""

CUT = 0.6
"""Fill below which a node counts as one of the surface."""

STEP = 1e-30
"""Of complex steps."""

THIRD = (-1.0, 3.0, -3.0, 1.0)
"""The third difference."""


class Ghost(NamedTuple):
    """The runs of the penalty, and for each node its runs."""

    run: Array  # (R, 4) nodes of each run
    scale: Array  # (R,) gamma mu fill dx^(D-2)
    nodes: Array  # (K,) nodes with a run, increasing
    begin: Array  # (K + 1,) where the runs of a node begin
    runs: Array  # the runs of each node
    factor: Array  # the node's factor in each of them, one of THIRD
    along: Array  # (R, 4) third difference of u, and (R, 4) of its cotangent: one substep's
    along_bar: Array


own_symbols(Ghost)


class Runs(NamedTuple):
    """The runs at rest: their nodes (R, 4), which of the four has the least fill (R,), and that fill (R,)."""

    run: Array
    lightest: Array
    fill: Array


def find_runs(patches: Patches, volume: Array, dx: float) -> Runs:
    """Return the runs for the volume sum_p w vol0 of every node (M,) [m^D]."""
    dim = patches.f.shape[1]
    fill, found = volume / dx**dim, []
    for axis in range(dim):
        run = _chains(patches, axis) if len(patches.table) else _rows(patches, axis)
        least = fill[run].min(axis=1)
        found.append(run[(least > 0) & (least < CUT)])
    run = np.concatenate(found)
    lightest = run[np.arange(len(run)), fill[run].argmin(axis=1)]
    return Runs(run.astype(np.int64), lightest, fill[lightest])


def _rows(patches: Patches, axis: int) -> Array:
    """Return all runs of four nodes along an axis in the boxes of the bodies (R, 4)."""
    dim, n = patches.f.shape[1], patches.n_nodes
    place, steps = _along(patches, axis), patches.strides[axis + 3 - dim] * np.arange(4)
    first = np.flatnonzero(place[: n - steps[-1]] + 3 == place[steps[-1] :])
    return np.asarray(first[:, None] + steps)


def _chains(patches: Patches, axis: int) -> Array:
    """Return the runs of four nodes along an axis of which neighbours share a stencil (R, 4).

    So no run leads across a gap. A node beside the end of a gap may have two neighbours, one on each side.
    """
    table = patches.table.reshape(-1, *(3,) * patches.f.shape[1])
    lower, upper = (np.take(table, part, axis=axis + 1).ravel() for part in ([0, 1], [1, 2]))
    pairs = np.unique(np.stack([lower, upper], axis=1), axis=0)
    chains = pairs
    for _ in range(2):
        begin, end = (np.searchsorted(pairs[:, 0], chains[:, -1], side) for side in ("left", "right"))
        many = end - begin
        within = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
        following = pairs[np.repeat(begin, many) + within, 1]
        chains = np.concatenate([np.repeat(chains, many, axis=0), following[:, None]], axis=1)
    return chains


def _along(patches: Patches, axis: int) -> Array:
    """Return a number for each node (M,) that grows by 1 along an axis in a body's box, and leaps between rows."""
    dim, pieces = patches.f.shape[1], []
    for body, shape in enumerate(patches.shapes()):
        index = np.indices(shape).reshape(dim, -1)
        others = np.ravel_multi_index(tuple(np.delete(index, axis, axis=0)), tuple(np.delete(shape, axis)))
        pieces.append(index[axis] + 10 * (1 + max(shape)) * (others + body * index.shape[1]))
    return np.concatenate(pieces)


def kernel_ghost(runs: Runs, scale: Array, real: Any) -> Ghost:
    """Return the kernels' view for the scale of each run (R,)."""
    flat = runs.run.reshape(-1)
    order = np.argsort(flat, kind="stable")
    nodes, begin = np.unique(flat[order], return_index=True)
    along, along_bar = aligned((len(scale), 4), real), aligned((len(scale), 4), real)
    return Ghost(
        runs.run, scale.astype(real), nodes, np.append(begin, len(flat)).astype(np.int64),
        (order // 4).astype(np.int64), np.array(THIRD, real)[order % 4], along, along_bar,
    )  # fmt: skip


def mean_modulus(model: Model, inputs: Inputs) -> Array:
    """Return the mean of mu over the volume of each body (B,) [Pa]; complex where the inputs are."""
    out = np.zeros(len(model.layout.counts), np.result_type(*(theta for group in inputs.terms for theta in group)))
    for body, part, thetas, shear in _bodies(model, inputs):
        share = inputs.fields.volume[part] / inputs.fields.volume[part].sum()
        out[body] = sum((mu(theta) @ share for mu, theta in zip(shear, thetas, strict=True)), 0.0)
    return out


def mean_modulus_vjp(model: Model, inputs: Inputs, modulus_bar: Array, bar: Inputs) -> None:
    """Add the cotangents of parameters and volumes to `bar`; slopes of mu by a complex step, which is exact."""
    for body, part, thetas, shear in _bodies(model, inputs):
        volume = inputs.fields.volume[part]
        for k, (mu, theta) in enumerate(zip(shear, thetas, strict=True)):
            group, columns = _place(model, body)
            for row in range(len(theta)):
                moved = theta.astype(complex)
                moved[row] += 1j * STEP
                slope = np.imag(np.asarray(mu(moved))) / STEP
                bar.terms[group][k][row, columns] += modulus_bar[body] * slope * volume / volume.sum()
            mean = mu(theta) @ volume / volume.sum()
            bar.fields.volume[part] += modulus_bar[body] * (mu(theta) - mean) / volume.sum()


def _bodies(model: Model, inputs: Inputs) -> Iterator[tuple[int, slice, list[Array], tuple[Any, ...]]]:
    """Yield each body with a shear modulus, its particles, and the parameters and moduli of its terms."""
    for body, part in enumerate(model.layout.slices()):
        group, columns = _place(model, body)
        if model.groups[group].shear:
            yield body, part, [theta[:, columns] for theta in inputs.terms[group]], model.groups[group].shear


def _place(model: Model, body: int) -> tuple[int, slice]:
    """Return the group of a body, and its columns in the group's parameters."""
    group = next(g for g, each in enumerate(model.groups) if body in each.bodies)
    begin, part = model.group_slices()[group].start, model.layout.slices()[body]
    return group, slice(part.start - begin, part.stop - begin)


@kernel
def third(ghost: Ghost, r: int, u: Array, stride: int, first: int) -> Any:
    """Return the third difference along a run; node n has record n * stride + first of u."""
    run = ghost.run
    outer = load4(u, run[r, 3] * stride + first) - load4(u, run[r, 0] * stride + first)
    return outer + (load4(u, run[r, 1] * stride + first) - load4(u, run[r, 2] * stride + first)) * 3.0


@kernel
def haunt(ghost: Ghost, run: NodeRun, u: Array, crew: Crew) -> None:
    """Add the penalty's forces to `run.force`."""
    lo, hi = share(len(ghost.scale), crew.thread, crew.n_threads)
    for r in range(lo, hi):
        store4(ghost.along, r, third(ghost, r, u, 1, 0) * ghost.scale[r])
    barrier(run.arrivals, crew.n_threads)
    lo, hi = share(len(ghost.nodes), crew.thread, crew.n_threads)
    for k in range(lo, hi):
        n = ghost.nodes[k]
        f = load4(run.force, n)
        for index in range(ghost.begin[k], ghost.begin[k + 1]):
            f = f - load4(ghost.along, ghost.runs[index]) * ghost.factor[index]
        store4(run.force, n, f)
    barrier(run.arrivals, crew.n_threads)


@kernel
def haunt_vjp(ghost: Ghost, run: NodeRun, bars: NodeBars, crew: Crew) -> None:
    """Run the adjoint at bars.pairs: add to bars.sums as `sweep.press_unit_vjp` does, and to bars.ghost."""
    lo, hi = share(len(ghost.scale), crew.thread, crew.n_threads)
    for r in range(lo, hi):
        by_u, by_p = third(ghost, r, bars.pairs, 2, 0), third(ghost, r, bars.pairs, 2, 1)
        bars.ghost[r] -= product(by_u, by_p)
        store4(ghost.along, r, by_u * ghost.scale[r])
        store4(ghost.along_bar, r, by_p * ghost.scale[r])
    barrier(run.arrivals, crew.n_threads)
    reversed_ = len(run.setting.rates) == 0
    lo, hi = share(len(ghost.nodes), crew.thread, crew.n_threads)
    for k in range(lo, hi):
        n = ghost.nodes[k]
        u_bar, f = load4(bars.sums, 2 * n), load4(bars.sums, 2 * n + 1)
        for index in range(ghost.begin[k], ghost.begin[k + 1]):
            u_bar = u_bar - load4(ghost.along_bar, ghost.runs[index]) * ghost.factor[index]
            if reversed_:
                f = f - load4(ghost.along, ghost.runs[index]) * ghost.factor[index]
        store4(bars.sums, 2 * n, u_bar)
        store4(bars.sums, 2 * n + 1, f)
    barrier(run.arrivals, crew.n_threads)


haunt_each = for_each(haunt)
haunt_each_vjp = for_each(haunt_vjp)

"""What the rest positions of the particles determine: nodes, stencils, and which boundaries hold them.

A model keeps it for its last rest positions, because every rollout of a fit needs it again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cqrun.boundaries.condition import NodeNormals
from cqrun.engine.model import Model
from cqrun.engine.reference.ghost import Runs, find_runs
from cqrun.engine.reference.held import Held, held_nodes
from cqrun.engine.reference.patches import Patches, make_patches
from cqrun.engine.reference.setting import Points
from cqrun.engine.stencils import SplitStencils, Stencils
from cqrun.engine.transfer import gather, gather_slopes, scatter_tile
from cqrun.numerics.compile import kernel
from cqrun.numerics.packed import aligned, pack
from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class RestGeometry:
    """The rest state of a model.

    Attributes:
        x: rest positions in user order (N, D) [m].
        patches: nodes, and the order of the particles.
        stencils: the stencils of all columns.
        rest: rest positions of all columns, packed (D, n) [m].
        kept: what is made when it is first needed.
        dx: spacing of the nodes [m].
    """

    x: Array
    patches: Patches
    stencils: Stencils | SplitStencils
    rest: Array
    dx: float
    kept: dict[str, Any] = field(default_factory=dict)

    def to_nodes(self, value: Array, gradient: Array | None = None) -> Array:
        """Return sum_p w (value_p + gradient_p d) at every node (M, K), d = X_n - X_p in cells.

        Args:
            value: (N, K), at most 3 numbers of each particle.
            gradient: (N, K, D).
        """
        out = aligned((self.patches.n_nodes, 4), np.float64)
        dims = (0,) * self.patches.f.shape[1]
        _scatter_all(out, *self._fields(value, gradient), self.exact, self.patches.strides, dims)
        return out[:, : value.shape[1]]

    def to_nodes_vjp(self, nodes_bar: Array, value: Array, gradient: Array | None = None) -> Array:
        """Return the cotangent of the particles' positions (N, D) from that of the result of `to_nodes` (M, K)."""
        dim, column = self.patches.f.shape[1], self.patches.layout.columns()
        grid = aligned((len(nodes_bar), 4), np.float64)
        grid[:, : value.shape[1]] = nodes_bar
        out = aligned((len(self.stencils.first), 4), np.float64)
        _slope_all(out, grid, *self._fields(value, gradient), self.exact, self.patches.strides, (0,) * dim)
        return np.asarray(out[column, 3 - dim : 3] / self.dx)

    def _fields(self, value: Array, gradient: Array | None) -> tuple[Array, Array]:
        """Return the affine fields of all particles as entries of a tile."""
        n, k, dim = len(self.stencils.first), value.shape[1], self.patches.f.shape[1]
        a, affine = aligned((n, 4), np.float64), aligned((3 * n, 4), np.float64)
        column = self.patches.layout.columns()
        a[column, :k] = value
        if gradient is not None:
            a[column, :k] -= np.einsum("nkd,nd->nk", gradient, self.patches.f[column])
            for axis in range(dim):
                affine[(axis + 3 - dim) * n + column, :k] = gradient[:, :, axis]
        return a, affine

    def to_particles(self, nodes: Array) -> tuple[Array, Array]:
        """Return sum_n w g_n (N, K), and sum_n w g_n d^T (N, K, D) with d in cells, of numbers of nodes (M, K)."""
        n, k, dim = len(self.stencils.first), nodes.shape[1], self.patches.f.shape[1]
        grid = aligned((len(nodes), 4), np.float64)
        grid[:, :k] = nodes
        value, moment = aligned((n, 4), np.float64), aligned((3 * n, 4), np.float64)
        _gather_all(grid, self.exact, value, moment, self.patches.strides, (0,) * dim)
        column = self.patches.layout.columns()
        columns = [moment[(axis + 3 - dim) * n + column, :k] for axis in range(dim)]
        return value[column, :k], np.stack(columns, axis=2)

    def runs(self, volume: Array, dx: float) -> Runs:
        """Return the runs of the ghost penalty for the particles' volumes (N,) [m^D]."""
        known = self.kept.get("runs")
        if known is None or not np.array_equal(known[0], volume):
            found = find_runs(self.patches, self.to_nodes(volume[:, None])[:, 0], dx)
            known = self.kept["runs"] = volume.copy(), found
        return known[1]

    @property
    def exact(self) -> Stencils | SplitStencils:
        """The stencils in float64."""
        return self.stencils if self.stencils.f.dtype == np.float64 else _stencils(self.patches, np.float64)

    def held(self, model: Model) -> Held:
        """Return which nodes the boundary conditions of a model hold."""
        known = self.kept.get("held")
        if known is None or known[0] is not model.conditions:
            known = self.kept["held"] = model.conditions, held_nodes(model, self.patches)
        held: Held = known[1]
        return held

    def conditions(self, model: Model, coefficients: Array) -> tuple[Any, ...]:
        """Return the kernels' views of the boundary conditions on these nodes."""
        views = []
        for k, condition in enumerate(model.conditions):
            view = condition.kernel(coefficients[k])
            if isinstance(view.normal, NodeNormals):
                view = view._replace(normal=NodeNormals(self.held(model).normals[k], view.normal.dims))
            views.append(view)
        return tuple(views)

    def points(self, columns: Array) -> Points:
        """Return the points at the particles in these kernel columns (P,)."""
        return make_points(columns, *self.weights(columns))

    def weights(self, columns: Array) -> tuple[Array, Array]:
        """Return the nodes of the stencils of kernel columns, and their weights, (P, 3^D) each."""
        return stencil_weights(self.patches, columns)


def stencil_weights(patches: Patches, columns: Array) -> tuple[Array, Array]:
    """Return the nodes of the stencils of kernel columns, and their weights, (P, 3^D) each."""
    each, weight = _along(patches.f[columns]), np.ones((len(columns), 1))
    for axis in range(patches.f.shape[1]):
        weight = (weight[:, :, None] * each[:, axis, None, :]).reshape(len(columns), 3 ** (axis + 1))
    return patches.nodes_of(columns), weight


def _along(f: Array) -> Array:
    """Return the weights along each axis (P, D, 3) at places f (P, D)."""
    return np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2], axis=-1)


def stencil_slopes(patches: Patches, columns: Array) -> Array:
    """Return the slopes of the weights of kernel columns (P, 3^D, D) [1/cell]."""
    f, dim = patches.f[columns], patches.f.shape[1]
    each, slope = _along(f), np.stack([f - 1.5, 2.0 - 2.0 * f, f - 0.5], axis=-1)
    step = np.indices((3,) * dim).reshape(dim, -1)
    out = np.ones((len(columns), 3**dim, dim))
    for axis in range(dim):
        for other in range(dim):
            out[:, :, axis] *= (slope if other == axis else each)[:, other, step[other]]
    return out


def make_points(columns: Array, node: Array, weight: Array) -> Points:
    """Return points from the particles' columns (P,), and the nodes and weights (P, 3^D) of the points."""
    flat, shares = node.reshape(-1), weight.reshape(-1)
    order = np.lexsort((np.arange(len(flat)), flat))
    nodes, begin = np.unique(flat[order], return_index=True)
    return Points(
        columns.astype(np.int64), node, weight, nodes.astype(np.int64),
        np.append(begin, len(flat)).astype(np.int64), (order // node.shape[1]).astype(np.int64), shares[order],
    )  # fmt: skip


def rest_geometry(model: Model, x: Array) -> RestGeometry:
    """Return the rest state of a model for rest positions x (N, D) [m] in user order."""
    kind = f"reference {model.dx} {model.real} {model.size} {model.offset}"
    known = model.at_rest.get(kind)
    if known is None or not np.array_equal(known.x, x):
        known = model.at_rest[kind] = _make(model, x)
    return known


def _make(model: Model, x: Array) -> RestGeometry:
    patches = make_patches(model.layout, x, model.dx, model.offset, model.lattice)
    rest = pack(x[patches.layout.source].T, model.real)
    return RestGeometry(x.copy(), patches, _stencils(patches, model.real), rest, model.dx)


def _stencils(patches: Patches, real: Any) -> Stencils | SplitStencils:
    f = aligned((len(patches.first), 4), real)
    dim = patches.f.shape[1]
    f[:, :3] = 1.0
    f[:, 3 - dim : 3] = patches.f
    if len(patches.table):
        return SplitStencils(patches.row * patches.table.shape[1], f, patches.table.reshape(-1))
    return Stencils(patches.first.astype(np.int64), f)


def nodes_before(model: Model, x_before: Array, patches: Patches) -> Array:
    """Return for each node (M,) its number when the particles rested at `x_before` (N, D) [m].

    A node that no particle reached has the number of the nearest node of its body that one did.
    """
    before = make_patches(model.layout, x_before, model.dx, model.offset, model.lattice)
    node, weight = stencil_weights(before, before.layout.columns())
    reached = np.unique(node[weight > 0.0])
    X, X_before = patches.positions(model.dx), before.positions(model.dx)[reached]
    body, body_before = patches.body_of_nodes(), before.body_of_nodes()[reached]
    out = np.zeros(patches.n_nodes, np.int64)
    for k in range(len(patches.origin)):
        own, own_before = body == k, body_before == k
        out[own] = reached[own_before][cKDTree(X_before[own_before]).query(X[own])[1]]
    return out


@kernel
def _scatter_all(grid: Array, value: Array, affine: Array, stencils: Stencils, strides: Any, dims: Any) -> None:
    scatter_tile(grid, (value,), (affine,), stencils, 0, value.shape[0], strides, dims)


@kernel
def _gather_all(grid: Array, stencils: Stencils, value: Array, moment: Array, strides: Any, dims: Any) -> None:
    gather(grid, stencils, value, moment, 0, value.shape[0], strides, dims)


@kernel
def _slope_all(
    out: Array, grid: Array, value: Array, affine: Array, stencils: Stencils, strides: Any, dims: Any
) -> None:
    gather_slopes(out, grid, 1, 0, value, affine, stencils, 0, value.shape[0], strides, dims)

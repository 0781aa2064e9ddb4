"""The corners of cells at which volumes are averaged (`volume.py`): their weights, their parameters, and cotangents."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from cqrun.engine.model import Inputs
from cqrun.engine.reference.rest import RestGeometry
from cqrun.engine.reference.setting import TILE
from cqrun.engine.reference.volume import Means, MeansBars, Numbers
from cqrun.engine.setting import Group
from cqrun.materials.term import has_volume
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import aligned, pack, unpack
from cqrun.plugin.contract import Array
from cqrun.state import PADDING


def hats(rest: RestGeometry) -> Any:
    """Return the hat functions (M, N) of all corners, numbered as nodes, at the particles in user order; sparse."""
    known = rest.kept.get("hats")
    if known is None:
        patches = rest.patches
        column = patches.layout.columns()
        dim, t = patches.f.shape[1], patches.f[column] - 0.5
        corner, weight = patches.corners_of(column), np.ones((len(column), 1))
        for axis in range(dim):
            each = np.stack([1.0 - t[:, axis], t[:, axis]], axis=1)
            weight = (weight[:, :, None] * each[:, None, :]).reshape(len(column), -1)
        particle = np.repeat(np.arange(len(column)), 2**dim)
        shape = (patches.n_nodes, len(column))
        known = rest.kept["hats"] = sparse.csr_array((weight.ravel(), (corner.ravel(), particle)), shape=shape)
    return known


def hat_slopes(rest: RestGeometry) -> list[Any]:
    """Return the derivatives of `hats` by the position along each axis [1/m], (M, N) each; sparse."""
    patches = rest.patches
    column = patches.layout.columns()
    dim, t = patches.f.shape[1], patches.f[column] - 0.5
    each = np.stack([1.0 - t, t], axis=-1)  # (N, D, 2)
    step, corner = np.indices((2,) * dim).reshape(dim, -1), patches.corners_of(column)
    particle, found = np.repeat(np.arange(len(column)), 2**dim), []
    for axis in range(dim):
        of_axis = each.copy()
        of_axis[:, axis] = np.array([-1.0, 1.0]) / rest.dx
        slope = np.prod([of_axis[:, other, step[other]] for other in range(dim)], axis=0)
        found.append(sparse.csr_array((slope.ravel(), (corner.ravel(), particle)), (patches.n_nodes, len(column))))
    return found


def numbers(count: int, real: Any, threads: int = 0) -> Numbers:
    """Return a row of zeros, or one for each thread."""
    each = aligned((max(1, threads) * count,), real)
    width = lane_width(real)
    if threads:
        return Numbers(each.reshape(threads, count), each.reshape(threads, count // width, 1, width))
    return Numbers(each, each.reshape(count // width, 1, width))


def make_means(rollout: Any, g: int) -> tuple[Means, ...]:
    """Return the means of group g of a rollout; none if volumes are local, or if no term has an energy of them."""
    model, group = rollout.model, model_terms(rollout, g)
    if not model.averaged or not group:
        return ()
    real, begin, end, count = model.real, *_nodes(rollout, g)
    volume, theta = mean_parameters(rollout, g)
    inverse = numbers(count, real)
    inverse.each[: end - begin] = np.divide(1.0, volume, out=np.zeros_like(volume), where=volume > 0.0)
    terms = tuple(_padded(model.groups[g].kernel_terms[k], theta[k], count, real) for k in group)
    local = tuple(rollout.groups[g].terms[k] for k in group)
    return (Means(begin, local, terms, inverse, numbers(count, real), numbers(TILE, real, rollout.threads)),)


def model_terms(rollout: Any, g: int) -> list[int]:
    """Return the numbers of the group's terms that have an energy of the volume."""
    own = rollout.groups[g].terms[: len(rollout.model.groups[g].kernel_terms)]
    return [k for k, term in enumerate(own) if has_volume(type(term))]


def mean_parameters(rollout: Any, g: int) -> tuple[Array, dict[int, Array]]:
    """Return V of the group's corners, and for each term with an energy of the volume the mean parameters there."""
    begin, end, _ = _nodes(rollout, g)
    part, volume = rollout.model.group_slices()[g], rollout.inputs.fields.volume
    weights = hats(rollout.rest)[begin:end, part]
    V, theta = weights @ volume[part], {}
    full = V > 0.0
    for k in model_terms(rollout, g):
        given = rollout.inputs.terms[g][k]
        mean = np.tile(given[:, :1], (1, end - begin))  # a corner without particles gets any legal value
        mean[:, full] = (weights @ (volume[part] * given).T).T[:, full] / V[full]
        theta[k] = mean
    return V, theta


def _nodes(rollout: Any, g: int) -> tuple[int, int, int]:
    """Return the first node of a group, the node after its last, and their number, padded to whole lanes."""
    bodies, begins = rollout.model.groups[g].bodies, rollout.rest.patches.begin
    begin, end = int(begins[bodies[0]]), int(begins[bodies[-1] + 1])
    return begin, end, -(-(end - begin) // PADDING) * PADDING


def _padded(make: Any, theta: Array, count: int, real: Any) -> Any:
    full = np.tile(theta[:, :1], (1, count))
    full[:, : theta.shape[1]] = theta
    return make(pack(full, real))


def with_bars(rollout: Any, g: int, group_bar: Group) -> tuple[tuple[Means, MeansBars], ...]:
    """Return the means of group g, if there are any, with their cotangents; its particles' are those of the group."""
    found = []
    for each in rollout.means[g]:
        real, count = rollout.model.real, len(each.inverse.each)
        terms = tuple(term._replace(theta=np.zeros_like(term.theta)) for term in each.terms)
        local = tuple(group_bar.terms[k] for k in model_terms(rollout, g))
        dim, width = rollout.model.dim, lane_width(real)
        slopes = aligned((rollout.model.layout.n // width, dim**2, width), real)
        at = (numbers(TILE, real, rollout.threads) for _ in range(2))
        found.append((each, MeansBars(local, terms, numbers(count, real), numbers(count, real), slopes, *at)))
    return tuple(found)


def add_means_bar(means: tuple[tuple[Means, MeansBars], ...], rollout: Any, g: int, bar: Inputs) -> None:
    """Add what the mean parameters give to those of the particles, to their volumes, and to their rest positions."""
    for _, bars in means:
        begin, end, _ = _nodes(rollout, g)
        part, (V, theta) = rollout.model.group_slices()[g], mean_parameters(rollout, g)
        full = V > 0.0
        weights, volume = hats(rollout.rest)[begin:end, part], rollout.inputs.fields.volume[part]
        for term, (k, mean) in zip(bars.terms, theta.items(), strict=True):
            share = np.zeros_like(mean)
            share[:, full] = unpack(term.theta)[:, : end - begin][:, full] / V[full]
            at_particles = (weights.T @ share.T).T
            bar.terms[g][k] += volume * at_particles
            # the mean of theta over V: each volume draws it to the particle's own value
            bar.fields.volume[part] += (rollout.inputs.terms[g][k] * at_particles).sum(axis=0)
            bar.fields.volume[part] -= weights.T @ (share * mean).sum(axis=0)
            if rollout.inputs.shaped:
                for axis, slope in enumerate(hat_slopes(rollout.rest)):
                    own = slope[begin:end, part].T
                    moved = (rollout.inputs.terms[g][k] * (own @ share.T).T).sum(axis=0)
                    bar.state.x[part, axis] += volume * (moved - own @ (share * mean).sum(axis=0))

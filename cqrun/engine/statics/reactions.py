"""Reactions: the force and the moment with which each boundary holds the bodies, and their adjoint.

A node on which the net force f acts is held with r = -(1 - P) f, where P projects on the directions that its boundaries
leave free. With the arms a_n = X_n + u_n - C of a boundary's nodes, where C is the centre of the X_n,

    R = sum_n r_n,    M = sum_n a_n x r_n.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.engine.model import Model
from cqrun.plugin.contract import Array


class Holder(NamedTuple):
    """The nodes that a boundary holds (n,), and their places at rest from their centre (n, D) [m]."""

    nodes: Array
    arms: Array


def holders(model: Model, bits: Array, X: Array) -> dict[str, Holder]:
    """Return the nodes of every boundary that holds any, by its name; a node counts for the first that holds it.

    Args:
        bits: the conditions that apply to each node (M,).
        X: its place at rest (M, D) [m].
    """
    found = {}
    for name in dict.fromkeys(condition.name for condition in model.conditions):
        own = sum(1 << k for k, condition in enumerate(model.conditions) if condition.name == name)
        nodes = np.flatnonzero((bits & -bits) & own)
        if len(nodes):
            found[name] = Holder(nodes, X[nodes] - X[nodes].mean(axis=0))
    return found


def resultant(holder: Holder, u: Array, r: Array) -> tuple[Array, Array]:
    """Return R (D,) [N] and M (1,) or (3,) [N m], for displacements u (M, 4) and reactions r (M, D) of all nodes."""
    force = r[holder.nodes]
    moment = turns(_arms(holder, u)).transpose(0, 2, 1) @ force[:, :, None]
    return force.sum(axis=0), moment[:, :, 0].sum(axis=0)


def resultant_vjp(holder: Holder, u: Array, r: Array, R_bar: Array, M_bar: Array) -> tuple[Array, Array]:
    """Return the cotangents of the reactions and the displacements of a boundary's nodes, both (n, D)."""
    r_bar = R_bar + (turns(_arms(holder, u)) @ M_bar[:, None])[:, :, 0]
    x = r[holder.nodes]
    # M_bar . (a x r) = a . (r x M_bar)
    a_bar = M_bar[0] * np.stack([x[:, 1], -x[:, 0]], axis=1) if x.shape[1] == 2 else np.cross(x, M_bar)
    return r_bar, a_bar


def _arms(holder: Holder, u: Array) -> Array:
    return np.asarray(holder.arms + u[holder.nodes, : holder.arms.shape[1]])


def turns(arms: Array) -> Array:
    """Return the displacements of small turns about each axis, for arms (n, D): (n, D, 1) in 2D and (n, 3, 3) in 3D."""
    if arms.shape[1] == 2:
        return np.stack([-arms[:, 1], arms[:, 0]], axis=1)[:, :, None]
    x, y, z = arms.T
    o = np.zeros_like(x)
    return np.stack([np.stack(v, axis=1) for v in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=2)

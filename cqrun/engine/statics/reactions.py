"""Reactions: the force and the moment with which each boundary holds the bodies, and their adjoint.

A node on which the net force f acts is held with r = -(1 - P) f, where P projects on the directions that its boundaries
leave free. Boundary k takes the part W_nk r_n of it; the parts of all boundaries at a node add up to 1 (holding.py).
With the arms a_n = X_n + u_n - C of a boundary's nodes, where C is its centre (`Model.center`),

    R_k = sum_n W_nk r_n,    M_k = sum_n a_n x W_nk r_n.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.engine.model import Model
from cqrun.engine.statics.holding import Planes, turns
from cqrun.plugin.contract import Array


class Holder(NamedTuple):
    """The nodes of which a boundary takes a reaction.

    Attributes:
        nodes: numbers (n,).
        arms: their places at rest from the boundary's centre (n, D) [m].
        parts: the part of each node's reaction that the boundary takes (n, D, D).
    """

    nodes: Array
    arms: Array
    parts: Array


def holders(model: Model, bits: Array, X: Array) -> dict[str, Holder]:
    """Return the nodes of every boundary that holds any, by its name; several may have a part of one node.

    Args:
        bits: the conditions that apply to each node (M,).
        X: its place at rest (M, D) [m].
    """
    planes, found = Planes(model.conditions, model.size, bits, X), {}
    held = np.flatnonzero(bits)
    shares = dict(zip(held.tolist(), planes.shares(held), strict=True))
    for name in planes.names:
        inside = np.flatnonzero(planes.of(name))
        if len(inside):
            parts = np.array([shares[n].parts[name] for n in inside.tolist()])
            takes = parts.any(axis=(1, 2))
            found[name] = Holder(inside[takes], (X[inside] - model.center(name, X[inside]))[takes], parts[takes])
    return found


def resultant(holder: Holder, u: Array, r: Array) -> tuple[Array, Array]:
    """Return R (D,) [N] and M (1,) or (3,) [N m], for displacements u (M, 4) and reactions r (M, D) of all nodes."""
    force = _taken(holder, r)
    moment = turns(_arms(holder, u)).transpose(0, 2, 1) @ force[:, :, None]
    return force.sum(axis=0), moment[:, :, 0].sum(axis=0)


def resultant_vjp(holder: Holder, u: Array, r: Array, R_bar: Array, M_bar: Array) -> tuple[Array, Array]:
    """Return the cotangents of the reactions and the displacements of a boundary's nodes, both (n, D)."""
    taken_bar = R_bar + (turns(_arms(holder, u)) @ M_bar[:, None])[:, :, 0]
    x = _taken(holder, r)
    # M_bar . (a x r) = a . (r x M_bar)
    a_bar = M_bar[0] * np.stack([x[:, 1], -x[:, 0]], axis=1) if x.shape[1] == 2 else np.cross(x, M_bar)
    return np.einsum("nji,nj->ni", holder.parts, taken_bar), a_bar


def _taken(holder: Holder, r: Array) -> Array:
    """Return what a boundary takes of the reactions of its nodes (n, D)."""
    return np.einsum("nij,nj->ni", holder.parts, r[holder.nodes])


def _arms(holder: Holder, u: Array) -> Array:
    return np.asarray(holder.arms + u[holder.nodes, : holder.arms.shape[1]])

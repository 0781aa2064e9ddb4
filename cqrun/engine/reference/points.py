"""Points that ride on particles: on surfaces that touch, and where forces pull.

A point moves with the affine motion of its particle, x_s = x_p + F_p (X_s - X_p). One whose particle is -1 is fixed in
the world: its weights are zero.
"""

from __future__ import annotations

import numpy as np

from cqrun.engine.reference.patches import Patches
from cqrun.engine.reference.rest import make_points, stencil_slopes, stencil_weights
from cqrun.engine.reference.setting import Points
from cqrun.plugin.contract import Array


def riding_points(patches: Patches, X: Array, particle: Array, x: Array, dx: float) -> Points:
    """Return points at rest at x (S, D) [m], each of which moves with the affine motion of its particle.

    w_sn = w_pn + grad w_pn . (X_s - X_p) = w_pn (1 + 4 / dx^2 d_pn . (X_s - X_p)), so that no other nodes are reached
    than those of the particle, which have mass. X (N, D) are the rest positions of particles.
    """
    columns = patches.layout.columns()[particle]
    node, weight = stencil_weights(patches, columns)
    f = patches.f[columns]
    share = 1.0 + 4.0 * np.einsum("skd,sd->sk", _arms(f), x - X[particle]) / dx
    share[particle < 0] = 0.0
    return make_points(columns, node, weight * share)


def _arms(f: Array) -> Array:
    """Return X_n - X_p of the nodes of stencils [cells] (S, 3^D, D), for the places f (S, D) of particles in them."""
    offsets = np.stack(np.meshgrid(*[np.arange(3)] * f.shape[1], indexing="ij"), axis=-1).reshape(-1, f.shape[1])
    return np.asarray(offsets[None] - f[:, None])


def riding_points_vjp(
    patches: Patches, X: Array, particle: Array, x: Array, dx: float, weight_bar: Array
) -> tuple[Array, Array]:
    """Return the cotangents of x (S, D) and of X (N, D) from those of the weights (S, 3^D)."""
    weight_bar = np.where(particle[:, None] < 0, 0.0, weight_bar)
    columns = patches.layout.columns()[particle]
    f, offset = patches.f[columns], x - X[particle]
    _, weight = stencil_weights(patches, columns)
    arm = _arms(f)
    share = 1.0 + 4.0 * np.einsum("skd,sd->sk", arm, offset) / dx
    x_bar = 4.0 / dx * np.einsum("sk,sk,skd->sd", weight_bar, weight, arm)
    # by the particle's position: its weights, the arms, and the offset
    own_bar = np.einsum("sk,sk,skd->sd", weight_bar, share, stencil_slopes(patches, columns)) / dx
    own_bar -= 4.0 / dx**2 * (weight_bar * weight).sum(axis=1)[:, None] * offset + x_bar
    X_bar = np.zeros(X.shape)
    np.add.at(X_bar, particle, own_bar)
    return x_bar, X_bar

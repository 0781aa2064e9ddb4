"""The turning bar as a finite-element problem: its stretch while it turns steadily, at finite strains.

In the turning axes the bar is at rest under the body force rho w^2 x, with x the deformed position. The bar starts
undeformed with the spin w_0. Its angular momentum stays, so it then turns at w = w_0 I_0 / I, with I the moment of
inertia about its centre. It turns in the plane of its first and its last axis. One quarter is solved (3D: one eighth),
because the bar is symmetric about each axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.convergence.elements import Elements, Material
from benchmarks.convergence.equilibrium import Held
from cqrun.plugin.contract import Array

MOST_ROUNDS = 60


@dataclass(frozen=True)
class Turning:
    """What the steadily turning bar is like.

    Attributes:
        stretch: stretch of the positions along the bar, that of the affine map that fits them best.
        stretch_of_F: mean over the volume of |F e|, with e the bar's axis.
        spin: angular velocity [rad/s].
    """

    stretch: float
    stretch_of_F: float
    spin: float


def turning_bar(material: Material, size: Sequence[float], spin: float, counts: Sequence[int]) -> Turning:
    """Return the steady state of a bar, in 2D in plane strain, that starts undeformed with a spin [rad/s].

    Args:
        size: edges of the bar (D,) [m], the longest first.
        spin: at the start [rad/s].
        counts: elements along half of each edge.

    Raises:
        RuntimeError: the bar finds no steady state: it turns too fast for its material.
    """
    body = Elements([np.linspace(0.0, 0.5 * edge, n + 1) for edge, n in zip(size, counts, strict=True)])
    X, plane = body.X, np.array([1.0, *[0.0] * (len(size) - 2), 1.0])
    held = Held(body, X > 1e-12, material)
    M = body.mass(material.density)

    def inertia(x: Array) -> float:
        return float((plane * x).ravel() @ (M @ (plane * x).ravel()))

    u, rate = np.zeros_like(X), spin
    for _ in range(MOST_ROUNDS):
        new = held.rest((rate**2 * (M @ (plane * (X + u)).ravel())).reshape(X.shape))
        change, u = float(np.abs(new - u).max()), new
        rate = spin * inertia(X) / inertia(X + u)
        if change <= 1e-10 * size[0]:
            along = (M @ (np.eye(body.D)[0] * X).ravel()).reshape(X.shape)[:, 0]
            F = body.deformation_gradient(u)
            of_F = float((body.weight * np.linalg.norm(F[..., 0], axis=-1)).sum() / body.weight.sum())
            return Turning(float(along @ (X + u)[:, 0] / (along @ X[:, 0])), of_F, rate)
    raise RuntimeError("no steady state: the bar turns too fast for its material")

"""Contact of the reference frame in plain NumPy, for complex steps: surface points against planes and balls.

A point s moves with the affine motion of its particle, w_sn = w_pn (1 + 4 / dx^2 d_pn . (X_s - X_p)). At depth h > 0
it feels N = max(0, K h + C h' h / (h + h0)) along the normal, and -K s' along the surface, where s' is the tangential
part of s + dt v, shortened to mu N / K: of all obstacles with friction, in the one in which it is deepest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cqrun.boundaries.solid import CAPSULE, PLANE, Solid
from cqrun.engine.model import Model
from cqrun.engine.reference.rub import ONSET

Array = np.ndarray


def distance(solid: Solid, x: Array) -> tuple[Array, Array]:
    """Return the signed distance and the normal at a position."""
    if solid.kind == PLANE:
        return (x - solid.points[0]) @ solid.directions[0], solid.directions[0].astype(x.dtype)
    assert solid.kind == CAPSULE
    assert (solid.points[0] == solid.points[1]).all()
    arm = x - solid.points[0]
    r = np.sqrt((arm * arm).sum())
    return r - solid.lengths[0], arm / r


@dataclass
class Touching:
    """The surface of a model, with the springs of its points.

    `stencils` are (node, weight, arm) of every particle, one node at a time. `branches` are those taken so far: the
    obstacle, and whether the point sticks, slides, or only presses.
    """

    model: Model
    coefficients: Array
    stencils: Sequence[tuple[Array, Array, Array]]
    X: Array
    springs: Array = field(init=False)
    branches: list[set[tuple[int, str]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        surface = self.model.surface
        self.springs = np.zeros(surface.x.shape, complex)
        p, A = surface.particle, 4 / self.model.dx**2
        offset = surface.x - self.X[p]
        self.node = np.stack([node[p] for node, _, _ in self.stencils], axis=1)
        self.weight = np.stack(
            [weight[p] * (1 + A * (arm[p] * offset).sum(axis=1)) for _, weight, arm in self.stencils], axis=1
        )

    def forces(self, u: Array, v: Array) -> Array:
        """Return the forces on the nodes, and move the springs on by a substep."""
        x = self.model.surface.x + np.einsum("sk,skd->sd", self.weight, u[self.node])
        speed = np.einsum("sk,skd->sd", self.weight, v[self.node])
        taken: set[tuple[int, str]] = set()
        force = np.array([self._on_point(s, x[s], speed[s], taken) for s in range(len(x))])
        self.branches.append(taken)
        out = np.zeros(u.shape, np.result_type(u, force))
        np.add.at(out, self.node, self.weight[:, :, None] * force[:, None, :])
        return out

    def _on_point(self, s: int, x: Array, v: Array, taken: set[tuple[int, str]]) -> Array:
        model, surface = self.model, self.model.surface
        K, Z, h0 = surface.stiffness[s], surface.impedance[s], ONSET * model.dx
        force, deepest, after = np.zeros(len(x), complex), None, np.zeros(len(x), complex)
        for o, obstacle in enumerate(model.obstacles):
            d, n = min((distance(solid, x) for solid in obstacle.solids), key=lambda found: found[0].real)
            N = K * -d + Z * obstacle.dashpot * -(v @ n) * d / (d - h0)
            if d.real < 0 and N.real <= 0:
                taken.add((o, "leaves"))
            if d.real < 0 < N.real:
                force = force + N * n
                taken.add((o, "presses"))
                if obstacle.rubs and (deepest is None or -d.real > deepest[0]):
                    deepest = -d.real, n, N, self.coefficients[obstacle.condition], o
        if deepest is not None:
            _, n, N, mu, o = deepest
            a = self.springs[s] + model.dt * v
            after = a - n * (n @ a)
            length = np.sqrt((after * after).sum())
            slides = (K * length).real >= (mu * N).real
            taken.add((o, "slides" if slides else "sticks"))
            if slides:
                after = after * mu * N / (K * length)
            force = force - K * after
        self.springs[s] = after
        return force

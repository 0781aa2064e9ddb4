"""Contact of the reference frame in plain NumPy, for complex steps: surface points against solids and facets.

A point s moves with the affine motion of its particle, w_sn = w_pn (1 + 4 / dx^2 d_pn . (X_s - X_p)). At depth h > 0
it feels N = max(0, K h + C h' h / (h + h0)) along the normal, and -K s' along the surface, where s' is the tangential
part of s + dt v, shortened to mu N / K: of all obstacles with friction, in the one in which it is deepest.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cqrun.boundaries.solid import CAPSULE, MESH, PLANE, Solid
from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.meeting import REACH
from cqrun.engine.reference.rub import ONSET
from cqrun.geometry.mesh_tree import mesh_triangles

Array = np.ndarray

BODIES = {"2D viscous": (2, True), "2D": (2, False), "3D": (3, False)}
"""Name -> dimension, and whether the material is viscous; a rollout without viscosity runs backwards."""


def distance(solid: Solid, x: Array) -> tuple[Array, Array]:
    """Return the signed distance and the normal at a position."""
    if solid.kind == PLANE:
        return (x - solid.points[0]) @ solid.directions[0], solid.directions[0].astype(x.dtype)
    if solid.kind == MESH:
        return _distance_to_mesh(solid, x)
    assert solid.kind == CAPSULE
    assert (solid.points[0] == solid.points[1]).all()
    arm = x - solid.points[0]
    r = np.sqrt((arm * arm).sum())
    return r - solid.lengths[0], arm / r


def _distance_to_mesh(solid: Solid, x: Array) -> tuple[Array, Array]:
    """Return those of a mesh: the nearest triangle by another library, and the sign by its winding number.

    Outside the mesh's box, where nothing is felt, the distance is that to the box.
    """
    import igl

    triangles = mesh_triangles(solid)
    vertices, faces, here = triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), x.real[None]
    if (outside := away(here[0], vertices)) > 0:
        return outside + 0 * x[0], 0 * x
    k = int(np.ravel(igl.point_mesh_squared_distance(here, vertices, faces)[1])[0])
    arm = x - nearest(x, triangles[k])[0] @ triangles[k]
    inside = np.ravel(igl.winding_number(vertices, faces, here))[0] > 0.5
    d = (-1 if inside else 1) * np.sqrt((arm * arm).sum())
    return d, arm / d


def away(x: Array, points: Array) -> float:
    """Return how far a position is from the box of points, 0 inside."""
    return float(np.linalg.norm(np.maximum(0, np.maximum(points.min(axis=0) - x, x - points.max(axis=0)))))


@dataclass
class Touching:
    """The surface of a model, with the springs of its points.

    `stencils` are (node, weight, arm) of every particle, one node at a time. `branches` are those taken so far: the
    obstacle, and whether the point sticks, slides, or only presses. `pushed` has the forces of the last substep: the
    obstacle, the place and the force.
    """

    model: Model
    inputs: Inputs
    stencils: Sequence[tuple[Array, Array, Array]]
    springs: Array = field(init=False)
    branches: list[set[tuple[int, str]]] = field(default_factory=list)
    pushed: list[tuple[int, Array, Array]] = field(default_factory=list)

    def __post_init__(self) -> None:
        surface = self.model.surface
        self.x = self.inputs.surface if len(self.inputs.surface) else surface.x
        self.springs = np.zeros(surface.x.shape, complex)
        p, A = surface.particle, 4 / self.model.dx**2
        offset = self.x - self.inputs.state.x[p]
        self.node = np.stack([node[p] for node, _, _ in self.stencils], axis=1)
        self.weight = np.stack(
            [weight[p] * (1 + A * (arm[p] * offset).sum(axis=1)) for _, weight, arm in self.stencils], axis=1
        )

    def forces(self, u: Array, v: Array) -> Array:
        """Return the forces on the nodes, and move the springs on by a substep."""
        x = self.x + np.einsum("sk,skd->sd", self.weight, u[self.node])
        speed = np.einsum("sk,skd->sd", self.weight, v[self.node])
        taken: set[tuple[int, str]] = set()
        self.pushed.clear()
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
                self.pushed.append((o, x, N * n))
                taken.add((o, "presses"))
                if obstacle.rubs and (deepest is None or -d.real > deepest[0]):
                    deepest = -d.real, n, N, self.inputs.coefficients[obstacle.condition], o
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
            self.pushed.append((o, x, -K * after))
        self.springs[s] = after
        return force


# --- bodies ----------------------------------------------------------------------------------------------------------


def nearest(x: Array, corner: Array) -> tuple[Array, float, float]:
    """Return the weights of a facet's corners (D, D) in its point nearest to x, the distance and the height.

    Each set of corners spans a plane, a line or a point; the nearest point of one of them with weights that are not
    negative is that of the facet.
    """
    dim, found = len(x), []
    for size in range(1, dim + 1):
        for chosen in itertools.combinations(range(dim), size):
            base, edges = corner[chosen[0]], corner[list(chosen[1:])] - corner[chosen[0]]
            inner = np.linalg.solve(edges @ edges.T, edges @ (x - base)) if size > 1 else np.zeros(0, x.dtype)
            weights = np.zeros(dim, x.dtype)
            weights[list(chosen)] = np.append(1 - inner.sum(), inner)
            if (weights.real >= 0).all():
                g = x - weights @ corner
                found.append((np.sqrt((g.real**2).sum()), size, weights))
    distance_, _, weights = min(found, key=lambda each: (each[0], -each[1]))
    edge = (corner[1:] - corner[0]).real
    n = np.array([edge[0, 1], -edge[0, 0]]) if dim == 2 else np.cross(*edge)
    return weights, distance_, (x - corner[0]).real @ n / np.linalg.norm(n)


@dataclass
class Meeting:
    """The surfaces of bodies that meet; see `Touching`. `branches` counts what happened."""

    model: Model
    mu: complex
    points: Touching
    body: Array
    springs: Array = field(init=False)
    branches: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.springs = np.zeros(self.model.surface.x.shape, complex)

    def forces(self, u: Array, v: Array) -> Array:
        """Return the forces on the nodes, and move the springs on by a substep."""
        node, weight = self.points.node, self.points.weight
        x = self.points.x + np.einsum("sk,skd->sd", weight, u[node])
        speed = np.einsum("sk,skd->sd", weight, v[node])
        force = np.zeros(x.shape, complex)
        for s in range(len(x)):
            f, weights = self._around(s, x)
            if f is None:
                self.springs[s] = 0
                continue
            corner = self.model.surface.facets[f]
            push = self._push(s, f, x[s] - weights @ x[corner], speed[s] - weights @ speed[corner])
            force[s] += push
            force[corner] -= weights[:, None] * push
            self.branches[f"{int((weights.real > 0).sum())} corners"] += 1
        out = np.zeros(u.shape, np.result_type(u, force))
        np.add.at(out, node, weight[:, :, None] * force[:, None, :])
        return out

    def _around(self, s: int, x: Array) -> tuple[int | None, Array]:
        facets, best, reach = self.model.surface.facets, (np.inf, None, np.zeros(0)), 0.5 * REACH * self.model.dx
        low, high = (each(x.real[facets], axis=1) for each in (np.min, np.max))
        near = np.all((x[s].real > low - reach) & (x[s].real < high + reach), axis=1)  # boxes; the others are far off
        for body in np.unique(self.body):
            own = np.flatnonzero(near & (self.body[facets[:, 0]] == body))
            if body == self.body[s] or not len(own):
                continue
            found = [(f, *nearest(x[s], x[facets[f]])) for f in own]
            least = min(each[2] for each in found)
            f, weights, distance_, height = max(
                (each for each in found if each[2] <= least * (1 + 1e-9)), key=lambda each: abs(each[3])
            )
            if height < 0 and distance_ < min(best[0], reach):
                best = distance_, f, weights
        return best[1], best[2]

    def _push(self, s: int, f: int, g: Array, v: Array) -> Array:
        model, surface, corner = self.model, self.model.surface, self.model.surface.facets[f]
        area, h = surface.area, np.sqrt((g * g).sum())
        k, z = surface.stiffness / area, surface.impedance / area
        K, C = (area[s] / (1 / a[s] + 1 / a[corner].mean()) for a in (k, z))
        n, h0 = -g / h, ONSET * model.dx
        N = K * h - C * model.meeting.dashpot * (v @ n) * h / (h + h0)
        a = self.springs[s] + model.dt * v
        after = a - n * (n @ a)
        length = np.sqrt((after * after).sum())
        if N.real <= 0:
            self.branches["leaves"] += 1
            self.springs[s] = 0
            return 0 * g
        mu = self.mu if model.meeting.rubs else 0.0
        slides = (K * length).real >= (mu * N).real
        self.branches["slides" if slides else "sticks"] += 1
        if slides:
            after = after * mu * N / (K * length)
        self.springs[s] = after
        return N * n - K * after

"""An independent solution for soft bodies of boxes, under pressure in their cavities: finite elements of second order.

scikit-fem gives the mesh, the basis functions and the quadrature (T. Gustafsson, G. D. McBain, J. Open Source Software
5 (2020) 2369). It is pure Python on NumPy and SciPy, so it installs wherever cqrun does; sfepy needs a compiler. The
law, the pressure that follows its face, and Newton's method are below, and nothing of them is shared with cqrun.

Neo-Hookean: P = mu (F - F^-T) + lam ln J F^-T. Fibres along an axis a: P += k/2 <|F a|^2 - 1> (F a) a^T, where <x> is
0 for x < 0. Pressure p on a face with the normal N out of the body at rest: force -p J F^-T N per area at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu
from skfem import Basis, ElementHex2, FacetBasis, MeshHex

Array = np.ndarray
Box = tuple[Sequence[float], Sequence[float]]
"""Lower and upper corner [m]."""

HELD = 1e-9
"""How far from a plane a node may be to lie on it [m]."""


def inside(x: Array, boxes: Sequence[Box]) -> Array:
    """Return which points x (3, ...) lie in one of the boxes."""
    found = np.zeros(x.shape[1:], bool)
    for low, high in boxes:
        found |= np.all([(low[d] <= x[d]) & (x[d] <= high[d]) for d in range(3)], axis=0)
    return found


def box_mesh(solid: Sequence[Box], hollow: Sequence[Box], size: float) -> MeshHex:
    """Return a mesh of hexahedra of at most `size` [m], whose faces lie on those of all boxes."""
    axes = []
    for d in range(3):
        planes = np.unique(np.round([corner[d] for box in (*solid, *hollow) for corner in box], 12))
        counts = np.ceil(np.diff(planes) / size - 1e-9).astype(int)
        pieces = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(planes[:-1], planes[1:], counts, strict=True)]
        axes.append(np.concatenate([*pieces, planes[-1:]]))
    mesh = MeshHex.init_tensor(*axes)
    middle = mesh.p[:, mesh.t].mean(axis=1)
    return mesh.restrict(np.flatnonzero(inside(middle, solid) & ~inside(middle, hollow)))


@dataclass
class SoftBody:
    """A body at rest, clamped where x = 0 and symmetric about y = 0.

    Args:
        solid, hollow: boxes of material, and of cavities in it [m].
        size: of elements [m].
        youngs_modulus, poissons_ratio: of the law.
        fibres: (boxes, axis, stiffness [Pa]) of each family; they pull, and do not push.
    """

    solid: Sequence[Box]
    hollow: Sequence[Box]
    size: float
    youngs_modulus: float
    poissons_ratio: float
    fibres: Sequence[tuple[Sequence[Box], int, float]] = ()
    basis: Any = field(init=False)
    faces: Any = field(init=False)
    pushes: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        mesh, element = box_mesh(self.solid, self.hollow, self.size), ElementHex2()
        self.basis = Basis(mesh, element, intorder=4)
        wall = mesh.facets_satisfying(lambda x: inside(x, self.hollow), boundaries_only=True)
        self.faces = FacetBasis(mesh, element, facets=wall, intorder=4)
        self.n, self.dofs = self.basis.N, self.basis.doflocs
        x, y = self.dofs[0], self.dofs[1]
        fixed = np.zeros((3, self.n), bool)
        fixed[:, np.abs(x) < HELD] = True
        fixed[1, np.abs(y) < HELD] = True
        self.free = np.flatnonzero(~fixed.T.ravel())
        points = np.asarray(self.basis.global_coordinates())
        self.stiff = [(inside(points, boxes), axis, k) for boxes, axis, k in self.fibres]

    def solve(self, pressures: Sequence[float], report: Callable[[str], None] = print) -> list[Array]:
        """Return the displacements (n, 3) [m] under each pressure [Pa], each from the one before."""
        u, found = np.zeros((self.n, 3)), []
        # at rest no fibre is stretched, so the first place is found with fibres that push as well
        for pressure, self.pushes in [(pressures[0], True), *((each, False) for each in pressures)]:
            first = None
            for step in range(30):
                residual, K = self.system(u, pressure)
                size = float(np.linalg.norm(residual[self.free]))
                first = first or size
                report(f"{pressure:.6g} Pa, step {step}: residual {size / first:.2e}")
                if size < 1e-9 * first:
                    break
                K = K.tocsc()[self.free][:, self.free]
                change = np.zeros(3 * self.n)
                change[self.free] = splu(K).solve(-residual[self.free])
                u = u + self.damped(u, change.reshape(-1, 3), pressure, residual)
            if not self.pushes:
                found.append(u.copy())
        return found

    def damped(self, u: Array, change: Array, pressure: float, residual: Array) -> Array:
        """Return a part of a step after which the residual does less work along it than before.

        The residual itself may grow: a slender body that bends is stretched by a straight step.
        """
        along, part = change.ravel()[self.free], 1.0
        work = abs(residual[self.free] @ along)
        while part > 1e-3:
            with np.errstate(invalid="ignore"):
                trial = self.system(u + part * change, pressure, tangent=False)[0]
            if abs(trial[self.free] @ along) < 0.8 * work:
                return part * change
            part *= 0.5
        raise ArithmeticError(f"no step is possible at {pressure:g} Pa: give smaller steps of the pressure")

    def system(self, u: Array, pressure: float, *, tangent: bool = True) -> tuple[Array, Any]:
        """Return the residual (3 n,) [N] and its derivative."""
        r, entries = np.zeros((self.n, 3)), []
        G, w, at = gradients(self.basis)
        F = np.eye(3)[:, :, None, None] + np.einsum("aei,akeq->ikeq", u[at], G)
        P, A = self.law(F)
        np.add.at(r, at, np.einsum("ikeq,akeq,eq->aei", P, G, w))
        if tangent:
            entries.append((stiffness(A, G, w), at))
        if pressure:
            force, slope = self.press(u, pressure)
            np.add.at(r, self.faces.dofs.element_dofs[:, self.faces.tind], force)
            entries.append((slope, self.faces.dofs.element_dofs[:, self.faces.tind]))
        return r.ravel(), assembled(entries, self.n) if tangent else None

    def law(self, F: Array) -> tuple[Array, Array]:
        """Return P (3, 3, e, q) and its derivative A (3, 3, 3, 3, e, q)."""
        E, nu, one = self.youngs_modulus, self.poissons_ratio, np.eye(3)
        mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
        M = np.linalg.inv(np.moveaxis(F, (0, 1), (-2, -1)))  # F^-1
        Finv = np.moveaxis(M, (-2, -1), (0, 1))
        J = np.linalg.det(np.moveaxis(F, (0, 1), (-2, -1)))
        log = np.log(np.where(J > 0, J, np.nan))
        P = mu * F + (lam * log - mu) * Finv.swapaxes(0, 1)
        A = mu * np.einsum("ij,kl->ikjl", one, one)[..., None, None]
        A = A + lam * np.einsum("kieq,ljeq->ikjleq", Finv, Finv)
        A = A - (lam * log - mu) * np.einsum("kjeq,lieq->ikjleq", Finv, Finv)
        for where, axis, k in self.stiff:
            f, stretch = F[:, axis], np.einsum("ieq,ieq->eq", F[:, axis], F[:, axis]) - 1.0
            pulls = k * where * (self.pushes | (stretch > 0.0))  # fibres that are shorter than at rest do nothing
            P[:, axis] += 0.5 * pulls * stretch * f
            A[:, axis, :, axis] += pulls * np.einsum("ieq,jeq->ijeq", f, f)
            A[:, axis, :, axis] += 0.5 * pulls * stretch * one[:, :, None, None]
        return P, A

    def press(self, u: Array, pressure: float) -> tuple[Array, Array]:
        """Return the forces (27, e, 3) of a pressure on the walls, as residuals, and their derivative (27,3,27,3,e)."""
        G, w, at = gradients(self.faces)
        at = self.faces.dofs.element_dofs[:, self.faces.tind]
        N = np.array([np.asarray(self.faces.basis[a][0]) for a in range(len(at))])
        normal = np.asarray(self.faces.normals)
        F = np.eye(3)[:, :, None, None] + np.einsum("aei,akeq->ikeq", u[at], G)
        e = levi_civita()
        # cof F N has the entries e_ijm e_kln F_jl F_mn N_k / 2
        cof_n = 0.5 * np.einsum("ijm,kln,jleq,mneq,keq->ieq", e, e, F, F, normal, optimize=True)
        force = np.einsum("ieq,aeq,eq->aei", pressure * cof_n, N, w)
        turn = np.einsum("ijm,kln,mneq,keq->ijleq", e, e, F, normal, optimize=True)
        slope = np.einsum("aeq,ijleq,bleq,eq->aibje", N, pressure * turn, G, w, optimize=True)
        return force, slope

    def turned(self, u: Array, boxes: Sequence[Box]) -> Array:
        """Return by how much the part of the body in some boxes has turned about y [rad]: the best rigid fit."""
        _, w, at = gradients(self.basis)
        x = np.asarray(self.basis.global_coordinates())
        N = np.array([np.asarray(self.basis.basis[a][0]) + 0 * w for a in range(len(at))])
        moved = x + np.einsum("aei,aeq->ieq", u[at], N)
        mass = w * inside(x, boxes)
        centre = [np.einsum("ieq,eq->i", each, mass) / mass.sum() for each in (x, moved)]
        B = np.einsum("ieq,keq,eq->ik", moved - centre[1][:, None, None], x - centre[0][:, None, None], mass)
        angle = np.arctan2(B[2, 0] - B[0, 2], B[0, 0] + B[2, 2])
        return np.asarray(angle)

    def volume(self, u: Array) -> float:
        """Return the volume of the cavities [m^3], both halves."""
        G, w, at = gradients(self.faces)
        at = self.faces.dofs.element_dofs[:, self.faces.tind]
        N = np.array([np.asarray(self.faces.basis[a][0]) for a in range(len(at))])
        x = np.asarray(self.faces.global_coordinates()) + np.einsum("aei,aeq->ieq", u[at], N)
        F = np.eye(3)[:, :, None, None] + np.einsum("aei,akeq->ikeq", u[at], G)
        e = levi_civita()
        cof_n = 0.5 * np.einsum("ijm,kln,jleq,mneq,keq->ieq", e, e, F, F, np.asarray(self.faces.normals), optimize=True)
        return -2.0 * float(np.einsum("ieq,ieq,eq->", x, cof_n, w)) / 3.0


def gradients(basis: Any) -> tuple[Array, Array, Array]:
    """Return slopes of the functions (27, 3, e, q), weights (e, q), and the numbers of the functions (27, e)."""
    at = basis.dofs.element_dofs
    at = at[:, basis.tind] if isinstance(basis, FacetBasis) else at
    G = np.array([np.asarray(basis.basis[a][0].grad) for a in range(len(at))])
    return G, np.asarray(basis.dx), at


def stiffness(A: Array, G: Array, w: Array) -> Array:
    """Return element matrices (27, 3, 27, 3, e), the sum of A_ikjl G_ak G_bl w over k, l and points q."""
    n, count, points = len(G), *w.shape
    right = np.ascontiguousarray(np.moveaxis(G * w, (2, 3), (0, 1)))  # (e, q, b, l)
    middle = np.ascontiguousarray(np.moveaxis(A, (4, 5, 1), (0, 1, 2)).reshape(count, points, 27, 3))  # (k i j, l)
    half = (middle @ right.swapaxes(2, 3)).reshape(count, 3 * points, 9 * n)  # (e, q k, i j b)
    left = np.moveaxis(G, (2, 3), (0, 1)).swapaxes(1, 2).reshape(count, n, 3 * points)  # (e, a, q k)
    K = (np.ascontiguousarray(left) @ half).reshape(count, n, 3, 3, n)  # (e, a, i, j, b)
    return K.transpose(1, 2, 4, 3, 0)


def assembled(entries: list[tuple[Array, Array]], n: int) -> Any:
    """Return the sum of element matrices (27, 3, 27, 3, e) as a sparse matrix (3 n, 3 n)."""
    rows, cols, values = [], [], []
    for K, at in entries:
        own = 3 * at[:, None, :] + np.arange(3)[None, :, None]
        row = np.broadcast_to(own[:, :, None, None, :], K.shape)
        rows.append(row.ravel())
        cols.append(np.broadcast_to(own[None, None], K.shape).ravel())
        values.append(K.ravel())
    data = np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))
    return coo_array(data, shape=(3 * n, 3 * n))


def levi_civita() -> Array:
    """Return the permutation symbol (3, 3, 3)."""
    e = np.zeros((3, 3, 3))
    e[0, 1, 2] = e[1, 2, 0] = e[2, 0, 1] = 1.0
    e[0, 2, 1] = e[2, 1, 0] = e[1, 0, 2] = -1.0
    return e

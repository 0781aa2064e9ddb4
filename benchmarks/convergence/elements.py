"""Quadratic finite elements (Q2) with a discontinuous linear pressure (P1), for finite strains, on a graded box.

The volume term lam/2 g(J)^2 uses the projection of g(J) onto linear functions in each element,

    W(u) = sum_e int mu W_mu(F) + lam/2 (Pi g(J))^2,      F = I + grad u,

which is the Q2/P1 element with its pressure p = lam Pi g(J) eliminated. The pair is stable (inf-sup), so it does not
lock as nu approaches 1/2 (Boffi, Brezzi, Fortin 2013, section 8.6). scikit-fem supplies mesh, shape functions,
quadrature and numbering.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from skfem import CellBasis, ElementHex2, ElementQuad2, MeshHex, MeshQuad

from benchmarks.convergence.laws import Law, cofactor, cofactor_derivative, lame
from cqrun.plugin.contract import Array

GAUSS = 5
"""Degree that the quadrature integrates exactly: three Gauss points an axis."""


@dataclass(frozen=True)
class Material:
    """A law with its numbers: E [Pa], nu, density [kg/m^3]."""

    law: Law
    youngs_modulus: float
    poissons_ratio: float
    density: float

    @property
    def lame(self) -> tuple[float, float]:
        """Return mu and lam [Pa]."""
        return lame(self.youngs_modulus, self.poissons_ratio)


class Elements:
    """Q2/P1 elements on a tensor-product mesh; a vector of unknowns is an array (nodes, D).

    Args:
        ticks: the element boundaries along each axis [m].

    Attributes:
        X: nodes (n, D) [m].
        nodes_of: the nodes of each element (elements, 3^D).
        dN: gradients of the shape functions (elements, points, 3^D, D) [1/m].
        N: values of the shape functions (elements, points, 3^D).
        weight: volume of each quadrature point (elements, points) [m^D].
    """

    def __init__(self, ticks: list[Array]) -> None:
        self.D = D = len(ticks)
        mesh, element = (MeshQuad, ElementQuad2()) if D == 2 else (MeshHex, ElementHex2())
        basis = CellBasis(mesh.init_tensor(*ticks), element, intorder=GAUSS)
        self.X = np.asarray(basis.doflocs.T)
        self.nodes_of = np.asarray(basis.element_dofs.T)
        self.weight = np.asarray(basis.dx)
        shape = self.weight.shape
        self.N = np.stack([np.broadcast_to(np.asarray(b[0]), shape) for b in basis.basis], -1)
        self.dN = np.stack([np.moveaxis(np.broadcast_to(b[0].grad, (D, *shape)), 0, -1) for b in basis.basis], 2)
        at = np.moveaxis(np.asarray(basis.global_coordinates()), 0, -1)
        centre, size = at.mean(1, keepdims=True), np.ptp(at, axis=1)[:, None]
        self.q = np.concatenate([np.ones((*shape, 1)), (at - centre) / size], -1)  # pressure functions (e, points, D+1)
        self.q_mass = np.einsum("eq,eqa,eqb->eab", self.weight, self.q, self.q)
        dofs = (D * self.nodes_of[:, :, None] + np.arange(D)).reshape(len(self.nodes_of), -1)
        self._rows, self._columns = (np.repeat(dofs, dofs.shape[1], 1).ravel(), np.tile(dofs, dofs.shape[1]).ravel())

    def deformation_gradient(self, u: Array) -> Array:
        """Return F (elements, points, D, D)."""
        return np.asarray(np.swapaxes(u[self.nodes_of], 1, 2)[:, None] @ self.dN + np.eye(self.D))

    def energy(self, material: Material, u: Array) -> float:
        """Return the elastic energy [J]."""
        mu, lam = material.lame
        F = self.deformation_gradient(u)
        g = self._projected(material.law.volume(np.linalg.det(F))[0])
        return float((self.weight * (mu * material.law.shear_energy(F) + 0.5 * lam * g**2)).sum())

    def forces(self, material: Material, u: Array) -> Array:
        """Return the derivative of the energy by the unknowns (n, D) [N]."""
        mu, lam = material.lame
        F = self.deformation_gradient(u)
        g, slope, _ = material.law.volume(np.linalg.det(F))
        p = lam * self._projected(g)
        P = mu * material.law.shear(F)[0] + (p * slope)[..., None, None] * cofactor(F)
        return self.gathered(np.einsum("eq,eqij,eqnj->eni", self.weight, P, self.dN, optimize=True))

    def stiffness(self, material: Material, u: Array, convex: bool = False) -> csc_matrix:
        """Return the second derivative of the energy (n D, n D) [N/m].

        Args:
            convex: set the negative eigenvalues of d2W/dF2 at each point to zero, so that the matrix is not indefinite.
        """
        mu, lam = material.lame
        F = self.deformation_gradient(u)
        g, slope, curve = material.law.volume(np.linalg.det(F))
        p, cof = lam * self._projected(g), cofactor(F)
        A = mu * material.law.shear(F)[1]
        A = A + (p * slope)[..., None, None, None, None] * cofactor_derivative(F)
        A += np.einsum("eq,eqij,eqkl->eqijkl", p * curve, cof, cof, optimize=True)
        K = self._element_matrices(_without_negative(A) if convex else A)
        b = np.einsum("eq,eqa,eqij,eqnj->eani", self.weight * slope, self.q, cof, self.dN, optimize=True)
        b = b.reshape(*b.shape[:2], -1)
        K += lam * np.swapaxes(b, 1, 2) @ np.linalg.solve(self.q_mass, b)
        return self._assembled(K)

    def mass(self, density: float) -> csc_matrix:
        """Return the consistent mass matrix (n D, n D) [kg]."""
        m = density * np.einsum("eq,eqn,eqm->enm", self.weight, self.N, self.N, optimize=True)
        return self._assembled(np.einsum("enm,ij->enimj", m, np.eye(self.D)).reshape(len(m), -1))

    def body_force(self, force: Array) -> Array:
        """Return the nodal forces (n, D) [N] of a force per volume (D,) [N/m^D]."""
        return self.gathered(np.einsum("eq,eqn,i->eni", self.weight, self.N, force))

    def gathered(self, per_element: Array) -> Array:
        """Return sums over elements (n, D) of values at their nodes (elements, 3^D, D)."""
        out = np.zeros_like(self.X)
        np.add.at(out, self.nodes_of, per_element)
        return out

    def face_weights(self, axis: int, at: float) -> Array:
        """Return the weights (n,) of the mean over the face X[axis] = at: Simpson's rule on each element's side."""
        on, weights = np.isclose(self.X[:, axis], at, rtol=0.0, atol=1e-12), np.ones(len(self.X))
        for other in range(self.D):
            if other != axis:
                ticks, place = np.unique(np.round(self.X[on, other], 12), return_inverse=True)
                steps, simpson = ticks[2::2] - ticks[:-2:2], np.zeros(len(ticks))
                for k, part in enumerate((1 / 6, 4 / 6, 1 / 6)):
                    simpson[k : len(ticks) - 2 + k : 2] += part * steps
                weights[on] *= simpson[place]
        weights[~on] = 0.0
        return weights / weights.sum()

    def _projected(self, values: Array) -> Array:
        """Return the projection (elements, points) of values onto linear functions in each element."""
        moments = np.einsum("eq,eqa,eq->ea", self.weight, self.q, values)
        return np.asarray(np.einsum("eqa,ea->eq", self.q, np.linalg.solve(self.q_mass, moments[..., None])[..., 0]))

    def _element_matrices(self, A: Array) -> Array:
        """Return sum over points of dN A dN^T (elements, 3^D D, 3^D D)."""
        n, D = self.dN.shape[2], self.D
        K = np.empty((len(A), n, D, n, D))
        G = np.swapaxes(self.dN, 1, 2).reshape(len(A), n, -1)  # (e, n, points D)
        weighted = self.weight[..., None, None] * self.dN
        for i in range(D):
            for k in range(D):
                left = np.swapaxes(weighted @ A[:, :, i, :, k, :], 1, 2).reshape(len(A), n, -1)
                K[:, :, i, :, k] = left @ np.swapaxes(G, 1, 2)
        return K.reshape(len(A), n * D, n * D)

    def _assembled(self, K: Array) -> csc_matrix:
        size = self.X.size
        return coo_matrix((np.ravel(K), (self._rows, self._columns)), (size, size)).tocsc()


def _without_negative(A: Array) -> Array:
    """Return d2W/dF2 (..., D, D, D, D) with its negative eigenvalues set to zero."""
    size = A.shape[-1] ** 2
    values, vectors = np.linalg.eigh(A.reshape(*A.shape[:-4], size, size))
    return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)).reshape(A.shape)


def graded(length: float, count: int, power: float) -> Array:
    """Return `count` + 1 ticks from 0 to `length`, finer towards 0: the first element has length count^-power."""
    return np.asarray(length * np.linspace(0.0, 1.0, count + 1) ** power)


def graded_to_both_ends(length: float, count: int, power: float) -> Array:
    """Return `count` + 1 ticks (count even), finer towards both ends."""
    half = graded(0.5 * length, count // 2, power)
    return np.concatenate([half, length - half[-2::-1]])

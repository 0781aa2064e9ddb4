"""cqrun's two elastic laws in plain NumPy, written again from their energies, for the finite-element references.

Each energy is a part in the shear modulus mu and a part in lam that depends on the volume ratio J = det F alone:

    fixed corotated    W = mu |F - R|^2                    + lam/2 (J - 1)^2      (Stomakhin et al. 2012)
    neo-Hookean        W = mu/2 (tr F F^T - D - 2 log J)   + lam/2 (log J)^2      (CQ2 eq 13)

The two parts are kept apart, because the mixed elements project g(J) = J - 1 or log J before they square it. In 2D, F
is the 2 x 2 block of a plane strain. `...` in a shape is any batch of points.
"""

from __future__ import annotations

import numpy as np

from cqrun.plugin.contract import Array

PERMUTATION = np.zeros((3, 3, 3))
PERMUTATION[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
PERMUTATION[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0


def lame(youngs_modulus: float, poissons_ratio: float) -> tuple[float, float]:
    """Return mu and lam [Pa] of the 3D material."""
    mu = youngs_modulus / (2.0 * (1.0 + poissons_ratio))
    return mu, 2.0 * mu * poissons_ratio / (1.0 - 2.0 * poissons_ratio)


class FixedCorotated:
    """mu |F - R|^2 and g(J) = J - 1."""

    name = "fixed_corotated"

    def shear_energy(self, F: Array) -> Array:
        """Return the first part of the energy over mu (...)."""
        return np.asarray(((F - rotation(F)) ** 2).sum((-1, -2)))

    def shear(self, F: Array) -> tuple[Array, Array]:
        """Return the first derivative (..., D, D) and the second (..., D, D, D, D) of the first part over mu."""
        R = rotation(F)
        return 2.0 * (F - R), 2.0 * (identity(F) - rotation_derivative(F, R))

    def volume(self, J: Array) -> tuple[Array, Array, Array]:
        """Return g, g' and g''."""
        return J - 1.0, np.ones_like(J), np.zeros_like(J)


class NeoHookean:
    """mu/2 (tr F F^T - D - 2 log J) and g(J) = log J."""

    name = "neo_hookean"

    def shear_energy(self, F: Array) -> Array:
        """Return the first part of the energy over mu (...)."""
        return np.asarray(0.5 * ((F**2).sum((-1, -2)) - F.shape[-1]) - np.log(np.linalg.det(F)))

    def shear(self, F: Array) -> tuple[Array, Array]:
        """Return the first derivative (..., D, D) and the second (..., D, D, D, D) of the first part over mu."""
        inverse = np.linalg.inv(F)
        A = identity(F) + np.einsum("...li,...jk->...ijkl", inverse, inverse)  # d F^-T = -F^-T dF^T F^-T
        return F - np.swapaxes(inverse, -1, -2), A

    def volume(self, J: Array) -> tuple[Array, Array, Array]:
        """Return g, g' and g''; NaN where J <= 0, so that Newton's step is halved."""
        J = np.where(J > 0.0, J, np.nan)
        return np.log(J), 1.0 / J, -1.0 / J**2


Law = FixedCorotated | NeoHookean
LAWS: dict[str, Law] = {law.name: law for law in (FixedCorotated(), NeoHookean())}


def identity(F: Array) -> Array:
    """Return dF/dF (D, D, D, D)."""
    D = F.shape[-1]
    return np.einsum("ik,jl->ijkl", np.eye(D), np.eye(D))


def cofactor(F: Array) -> Array:
    """Return dJ/dF = J F^-T (..., D, D), also where F is singular."""
    if F.shape[-1] == 2:
        return np.stack([F[..., 1, 1], -F[..., 1, 0], -F[..., 0, 1], F[..., 0, 0]], -1).reshape(F.shape)
    rows = [np.cross(F[..., (i + 1) % 3, :], F[..., (i + 2) % 3, :]) for i in range(3)]
    return np.stack(rows, -2)


def cofactor_derivative(F: Array) -> Array:
    """Return d2J/dF2 (..., D, D, D, D)."""
    if F.shape[-1] == 2:
        e = np.array([[0.0, 1.0], [-1.0, 0.0]])
        return np.broadcast_to(np.einsum("ik,jl->ijkl", e, e), (*F.shape, 2, 2))
    return np.asarray(np.einsum("ikm,jln,...mn->...ijkl", PERMUTATION, PERMUTATION, F, optimize=True))


def rotation(F: Array) -> Array:
    """Return the rotation R of the polar decomposition F = R S (..., D, D), with det R = 1."""
    U, _, Vt = np.linalg.svd(F)
    U[..., :, -1] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt)


def rotation_derivative(F: Array, R: Array) -> Array:
    """Return dR/dF (..., D, D, D, D).

    With R' = R [w]x, the skew part of R^T F' is that of [w]x S, so (tr S I - S) w is the axial vector of
    R^T F' - F'^T R; in 2D, tr S w is its one entry. T holds R [e_n]x, so dR/dF = T (tr S I - S)^-1 T^T.
    """
    S = np.swapaxes(R, -1, -2) @ F
    trace = np.trace(S, axis1=-2, axis2=-1)
    if F.shape[-1] == 2:
        T = R @ np.array([[0.0, -1.0], [1.0, 0.0]])
        return np.asarray(np.einsum("...ij,...kl->...ijkl", T, T) / trace[..., None, None, None, None])
    inverse = np.linalg.inv(trace[..., None, None] * np.eye(3) - S)
    T = np.einsum("...im,mjn->...ijn", R, -PERMUTATION)
    return np.asarray(np.einsum("...ijn,...nm,...klm->...ijkl", T, inverse, T, optimize=True))

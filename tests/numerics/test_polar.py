"""The polar factor where it is delicate, and its adjoint, against the singular value decomposition."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack
from cqrun.numerics.polar import nearest_rotation, polar, polar_vjp
from cqrun.numerics.tensor import det, inner


def rotations(n: int, dim: int, rng: np.random.Generator) -> np.ndarray:
    """Return random rotations (n, D, D)."""
    Q = np.linalg.qr(rng.normal(size=(n, dim, dim)))[0]
    Q[:, 0] *= np.linalg.det(Q)[:, None]
    return Q


def signed_svd(F: np.ndarray) -> np.ndarray:
    """Return the rotations nearest to F (n, D, D): U V^T, the smallest singular value taken negative if need be."""
    U, _, Vt = np.linalg.svd(F)
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt


def with_values(values: list[float], rng: np.random.Generator, n: int = 20) -> np.ndarray:
    """Return matrices U diag(values) V^T for random rotations U, V, (n, D, D)."""
    dim = len(values)
    return rotations(n, dim, rng) * np.array(values) @ rotations(n, dim, rng)


CASES = {
    "rest": [1.0, 1.0, 1.0],
    "equal": [1.7, 1.7, 1.7],
    "two equal": [1.3, 0.6, 0.6],
    "nearly equal": [1.0, 1.0 + 1e-9, 1.0 - 1e-9],
    "small strain": [1.01, 0.99, 1.002],
    "strong stretch": [3.0, 1.0, 0.1],
    "stronger": [3.0, 3.0, 0.1],
    "squeezed": [0.1, 0.1, 0.1],
    "inverted": [1.2, 0.9, -0.5],
    "inverted, near a flip": [1.2, 0.9, -0.85],
    "inverted thrice": [-1.0, -0.9, -0.5],
}
CASE = pytest.mark.parametrize("values", CASES.values(), ids=CASES.keys())
DIM = pytest.mark.parametrize("dim", [2, 3])


def of_dim(values: list[float], dim: int) -> list[float]:
    """Return the singular values of a case in 2D: its first and its last."""
    return values if dim == 3 else [values[0], values[-1]]


def as_tuple(A: np.ndarray) -> tuple:
    """Return matrices (n, D, D) as the tuple of arrays that the functions take."""
    return tuple(A.reshape(len(A), -1).T)


def as_matrices(a: tuple) -> np.ndarray:
    """Return a tuple of arrays as matrices (n, D, D)."""
    dim = 2 if len(a) == 4 else 3
    return np.array(a).T.reshape(-1, dim, dim)


@CASE
@DIM
def test_it_is_the_nearest_rotation(values, dim, rng):
    F = with_values(of_dim(values, dim), rng)
    R = as_matrices(polar(as_tuple(F)))
    np.testing.assert_allclose(R, signed_svd(F), rtol=0, atol=1e-12)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(dim), (len(R), 1, 1)), atol=1e-13)
    assert np.all(np.linalg.det(R) > 0)


@DIM
def test_at_rest_it_is_exact(dim):
    rest = np.eye(dim)[None]
    np.testing.assert_array_equal(as_matrices(polar(as_tuple(rest))), rest)


def jvp(F: np.ndarray, F_dot: np.ndarray) -> np.ndarray:
    """Return dR for dF: complex step of Newton's iteration, and Richardson of `polar` where det F < 0."""
    if np.all(np.linalg.det(F) > 0):
        R = F + 1e-30j * F_dot
        for _ in range(30):
            R = (R + np.swapaxes(np.linalg.inv(R), 1, 2)) / 2
        return R.imag / 1e-30
    h = 1e-3

    def centred(h: float) -> np.ndarray:
        ahead, behind = polar(as_tuple(F + h * F_dot)), polar(as_tuple(F - h * F_dot))
        return (as_matrices(ahead) - as_matrices(behind)) / (2 * h)

    a, b, c = centred(h), centred(h / 2), centred(h / 4)
    a, b = (4 * b - a) / 3, (4 * c - b) / 3
    return (16 * b - a) / 15


@pytest.mark.parametrize("values", [v for k, v in CASES.items() if k != "inverted, near a flip"])
@DIM
def test_its_adjoint(values, dim, rng):
    values = of_dim(values, dim)
    F, (F_dot, R_bar) = with_values(values, rng), rng.normal(size=(2, 20, dim, dim))
    # in the case of squeezed or inverted matrices R turns fast: a small step for the differences
    F_dot = F_dot * min(abs(values[i] + values[j]) for i in range(dim) for j in range(i)) / 2
    R = polar(as_tuple(F))
    F_bar = as_matrices(polar_vjp(as_tuple(F), R, as_tuple(R_bar)))
    forward, backward = (jvp(F, F_dot) * R_bar).sum((1, 2)), (F_bar * F_dot).sum((1, 2))
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9 * np.abs(forward).max())


@pytest.mark.parametrize(("real", "close"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_of_rank_one_it_is_a_nearest_rotation_whatever_sign_rounding_gives_det_F(real, close, rng):
    """Newton may end at a reflection there, and at a rotation that is not nearest. Of a b^T tr(R^T F) is |a| |b|."""
    a, b = rng.normal(size=(2, 300, 3, 1))
    F = a / np.linalg.norm(a, axis=1, keepdims=True) * np.swapaxes(b, 1, 2) / np.linalg.norm(b, axis=1)[:, None]
    F = F.astype(real)
    signs = np.sign(det(as_tuple(F)))
    assert min((signs > 0).sum(), (signs < 0).sum()) > 80
    with np.errstate(all="ignore"):  # if rounding gives zero, Newton divides by it
        R = as_matrices(polar(as_tuple(F)))
    np.testing.assert_allclose(np.linalg.det(R.astype(float)), 1.0, atol=close)
    np.testing.assert_allclose((R * F).sum((1, 2)), 1.0, atol=close)


def test_its_derivative_is_not_the_one_of_the_published_code(rng):
    """The 3D code of CQ1 divides a block of dP/dF by s2 s2 where s1 s2 belongs: 3 % off at strains of 30 %.

    The adjoint must be the derivative at large strains, with all three values apart, not only near rest.
    """
    F, (F_dot, R_bar) = with_values([1.4, 1.0, 0.65], rng), rng.normal(size=(2, 20, 3, 3))
    F_bar = as_matrices(polar_vjp(as_tuple(F), polar(as_tuple(F)), as_tuple(R_bar)))
    np.testing.assert_allclose((F_bar * F_dot).sum((1, 2)), (jvp(F, F_dot) * R_bar).sum((1, 2)), rtol=1e-10)


@DIM
def test_where_signed_values_cancel_the_adjoint_is_bounded(dim):
    """At s_i + s_j = 0 no rotation is nearest; what comes back must be a rotation and a finite cotangent."""
    values = [1.2, 0.5, -0.5] if dim == 3 else [0.5, -0.5]
    F = np.diag(values)[None]
    R = polar(as_tuple(F))
    np.testing.assert_allclose(np.linalg.det(as_matrices(R)), 1.0)
    F_bar = polar_vjp(as_tuple(F), R, as_tuple(np.ones((1, dim, dim))))
    assert np.all(np.isfinite(np.array(F_bar)))


def test_what_is_not_finite_is_handed_back():
    F = (np.nan,) * 9
    np.testing.assert_array_equal(nearest_rotation(F), F)


@kernel
def polar_on_lanes(table, out, width, dims):
    for i in range(0, table.shape[0] * width, width):
        if len(dims) == 2:
            F = (load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i))
            G = (load(table, 4, i), load(table, 5, i), load(table, 6, i), load(table, 7, i))
        else:
            F = (
                load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i), load(table, 4, i),
                load(table, 5, i), load(table, 6, i), load(table, 7, i), load(table, 8, i),
            )  # fmt: skip
            G = (
                load(table, 9, i), load(table, 10, i), load(table, 11, i), load(table, 12, i), load(table, 13, i),
                load(table, 14, i), load(table, 15, i), load(table, 16, i), load(table, 17, i),
            )  # fmt: skip
        R = polar(F)
        bar = polar_vjp(F, R, G)
        store(out, 0, i, R[0])
        store(out, 1, i, R[1])
        store(out, 2, i, R[-1])
        store(out, 3, i, inner(R, G))
        store(out, 4, i, inner(bar, G))
        store(out, 5, i, inner(bar, bar))


@pytest.mark.parametrize(("real", "close"), [(np.float64, 1e-12), (np.float32, 3e-4)])
@DIM
def test_compiled_lanes_of_mixed_cases(dim, real, close, rng):
    """Lanes in which some entries are inverted and others converge early, others late."""
    kinds = [of_dim(v, dim) for k, v in CASES.items() if k not in ("squeezed", "inverted, near a flip")]
    F = np.concatenate([with_values(v, rng, 16) for v in kinds] + [with_values(kinds[0], rng, 16)])
    F = F[rng.permutation(len(F))].astype(real).astype(float)
    G = rng.normal(size=F.shape).astype(real).astype(float)
    width = lane_width(real)
    table = pack(np.array([*as_tuple(F), *as_tuple(G)]), real)
    out = np.zeros((table.shape[0], 6, width), real)
    polar_on_lanes(table, out, width, (0,) * dim)
    R = polar(as_tuple(F))
    bar = polar_vjp(as_tuple(F), R, as_tuple(G))
    want = np.array([R[0], R[1], R[-1], inner(R, as_tuple(G)), inner(bar, as_tuple(G)), inner(bar, bar)])
    size = np.abs(want).max(1)[:, None]
    np.testing.assert_allclose(unpack(out) / size, want / size, rtol=0, atol=close)

"""Small tensors against NumPy's, in plain Python and compiled, on numbers and on lanes."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.numerics import tensor
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack

T = np.swapaxes
NUMPY = {
    "mul": (lambda A, B: A @ B),
    "mul_bt": (lambda A, B: A @ T(B, -1, -2)),
    "mul_at": (lambda A, B: T(A, -1, -2) @ B),
    "add": (lambda A, B: A + B),
    "sub": (lambda A, B: A - B),
    "transpose": (lambda A, B: T(A, -1, -2)),
    "symmetric": (lambda A, B: (A + T(A, -1, -2)) / 2),
    "cofactor": (lambda A, B: np.linalg.det(A)[:, None, None] * T(np.linalg.inv(A), -1, -2)),
    "plus_diagonal": (lambda A, B: A + np.trace(B, axis1=1, axis2=2)[:, None, None] * np.eye(A.shape[-1])),
    "scale": (lambda A, B: A * np.linalg.det(B)[:, None, None]),
    "shift": (lambda A, B: A + np.einsum("pij,pij->p", A, B)[:, None, None]),
    "outer": (lambda A, B: np.einsum("pi,pj->pij", A[:, 0], B[:, 0])),
}
"""What `everything` computes, for A, B of shape (n, D, D)."""


def everything(a, b):
    """Return the results named in NUMPY for two matrices, one after the other."""
    first_a, first_b = a[: len(a) // 4 + 1], b[: len(b) // 4 + 1]
    u, w = tensor.matvec(a, first_b), tensor.matvec_t(b, first_a)
    return (
        tensor.mul(a, b), tensor.mul_bt(a, b), tensor.mul_at(a, b), tensor.add(a, b), tensor.sub(a, b),
        tensor.transpose(a), tensor.symmetric(a), tensor.cofactor(a), tensor.plus_diagonal(a, tensor.trace(b)),
        tensor.scale(a, tensor.det(b)), tensor.shift(a, tensor.inner(a, b)),
        tensor.outer(first_a, first_b),
    ), (u, w, tensor.dot(u, w))  # fmt: skip


def expected(A, B):
    """Return NumPy's results, (n, D, D) each, then A b, B^T a, and their product, a and b the first rows."""
    u, w = np.einsum("pij,pj->pi", A, B[:, 0]), np.einsum("pji,pj->pi", B, A[:, 0])
    return [f(A, B) for f in NUMPY.values()], (u, w, (u * w).sum(1))


@pytest.mark.parametrize("dim", [2, 3])
def test_on_arrays(dim, rng):
    """Without the JIT a tensor's entries are arrays of particles, complex ones too."""
    A, B = rng.normal(size=(2, 7, dim, dim)) + 1j * rng.normal(size=(2, 7, dim, dim))
    got, (u, w, uw) = everything(tuple(A.reshape(7, -1).T), tuple(B.reshape(7, -1).T))
    want, (u_ref, w_ref, uw_ref) = expected(A, B)
    for name, g, r in zip(NUMPY, got, want, strict=True):
        np.testing.assert_allclose(np.array(g).T.reshape(7, dim, dim), r, rtol=1e-12, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(np.array(u).T, u_ref, rtol=1e-12)
    np.testing.assert_allclose(np.array(w).T, w_ref, rtol=1e-12)
    np.testing.assert_allclose(uw, uw_ref, rtol=1e-12)


@kernel
def lanes_2d(table, out, width):
    for i in range(0, table.shape[0] * width, width):
        a = (load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i))
        b = (load(table, 4, i), load(table, 5, i), load(table, 6, i), load(table, 7, i))
        c = tensor.sub(tensor.add(tensor.mul(a, b), tensor.mul_bt(a, b)), tensor.mul_at(a, b))
        c = tensor.scale(tensor.add(c, tensor.symmetric(tensor.cofactor(a))), tensor.det(b))
        d = tensor.matvec(tensor.plus_diagonal(tensor.transpose(c), tensor.trace(b)), a[:2])
        store(out, 0, i, d[0])
        store(out, 1, i, d[1])
        store(out, 2, i, tensor.inner(c, tensor.outer(d, tensor.matvec_t(a, b[:2]))))
        store(out, 3, i, tensor.dot(tensor.shift(d, 1.0), d))


@kernel
def lanes_3d(table, out, width):
    for i in range(0, table.shape[0] * width, width):
        a = (
            load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i), load(table, 4, i),
            load(table, 5, i), load(table, 6, i), load(table, 7, i), load(table, 8, i),
        )  # fmt: skip
        b = (
            load(table, 9, i), load(table, 10, i), load(table, 11, i), load(table, 12, i), load(table, 13, i),
            load(table, 14, i), load(table, 15, i), load(table, 16, i), load(table, 17, i),
        )  # fmt: skip
        c = tensor.sub(tensor.add(tensor.mul(a, b), tensor.mul_bt(a, b)), tensor.mul_at(a, b))
        c = tensor.scale(tensor.add(c, tensor.symmetric(tensor.cofactor(a))), tensor.det(b))
        d = tensor.matvec(tensor.plus_diagonal(tensor.transpose(c), tensor.trace(b)), a[:3])
        store(out, 0, i, d[0])
        store(out, 1, i, d[1])
        store(out, 2, i, tensor.inner(c, tensor.outer(d, tensor.matvec_t(a, b[:3]))))
        store(out, 3, i, tensor.dot(tensor.shift(d, 1.0), d))


@pytest.mark.parametrize(("real", "close"), [(np.float64, 1e-13), (np.float32, 1e-4)])
@pytest.mark.parametrize(("dim", "on_lanes"), [(2, lanes_2d), (3, lanes_3d)])
def test_compiled_lanes_are_the_plain_functions(dim, on_lanes, real, close, rng):
    width = lane_width(real)
    table = rng.normal(size=(2 * dim * dim, 3 * width)).astype(real)
    A, B = table.astype(float).reshape(2, dim, dim, -1).transpose(0, 3, 1, 2)
    packed = pack(table, real)
    out = np.zeros((3, 4, width), real)
    on_lanes(packed, out, width)
    got = unpack(out)
    c = A @ B + A @ T(B, 1, 2) - T(A, 1, 2) @ B
    cof = NUMPY["cofactor"](A, B)
    c = (c + (cof + T(cof, 1, 2)) / 2) * np.linalg.det(B)[:, None, None]
    d = np.einsum("pij,pj->pi", T(c, 1, 2) + np.trace(B, axis1=1, axis2=2)[:, None, None] * np.eye(dim), A[:, 0])
    e = np.einsum("pij,pi,pj->p", c, d, np.einsum("pji,pj->pi", A, B[:, 0]))
    want = np.array([d[:, 0], d[:, 1], e, ((d + 1) * d).sum(1)])
    np.testing.assert_allclose(got, want, rtol=0, atol=close * np.abs(want).max())


def test_a_tuple_that_is_no_tensor_is_refused():
    with pytest.raises(TypeError, match="a tuple of 5 is not a tensor of rank 2"):
        tensor.trace((1.0,) * 5)
    with pytest.raises(TypeError, match="a tuple of 4 is not a tensor of rank 1"):
        tensor.dot((1.0,) * 4, (1.0,) * 4)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_cofactor_is_the_derivative_of_the_determinant(dim, rng):
    A, A_dot = rng.normal(size=(2, dim, dim))
    moved = tensor.det(tuple((A + 1e-30j * A_dot).ravel())).imag / 1e-30
    assert tensor.inner(tensor.cofactor(tuple(A.ravel())), tuple(A_dot.ravel())) == pytest.approx(moved, rel=1e-13)

"""The rotation of a deformation gradient: what it is, and its adjoint wherever it is smooth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cqrun.errors import CrushedError
from cqrun.measurements.rotation import rotation, rotation_vjp


def near_rest(dim, rng, strain, count=6):
    """Return (count, dim, dim) rotations times stretches."""
    return some_rotations(dim, rng, count) @ (np.eye(dim) + strain * rng.normal(size=(count, dim, dim)))


def some_rotations(dim, rng, count):
    if dim == 3:
        return Rotation.random(count, rng=rng).as_matrix()
    c, s = np.cos(angle := rng.uniform(-3, 3, count)), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def richardson(f, h):
    """Return df/dh at 0 by differences of fourth order."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


@pytest.mark.parametrize("dim", [2, 3])
def test_rotation_times_symmetric(dim, rng):
    F = near_rest(dim, rng, 0.3)
    R = rotation(F)
    S = np.swapaxes(R, -1, -2) @ F
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(dim), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(S, np.swapaxes(S, -1, -2), atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_exact_for_rotations_and_for_rest(dim, rng):
    R = some_rotations(dim, rng, 20)
    np.testing.assert_allclose(rotation(R), R, atol=1e-14)
    np.testing.assert_array_equal(rotation(np.eye(dim)[None]), np.eye(dim)[None])


def test_stays_a_rotation_when_turned_inside_out():
    R = rotation(np.diag([1.0, 1.0, -0.2])[None])
    np.testing.assert_allclose(R[0], np.eye(3), atol=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("case", ["at rest", "strained", "equal stretches", "inside out"])
def test_adjoint(dim, rng, case):
    F = {
        "at rest": np.eye(dim)[None],
        "strained": near_rest(dim, rng, 0.3),
        "equal stretches": 1.7 * some_rotations(dim, rng, 4),
        "inside out": np.diag([1.0, 0.9, -0.3][3 - dim :])[None] + 0.01 * rng.normal(size=(3, dim, dim)),
    }[case]
    dF, R_bar = rng.normal(size=F.shape), rng.normal(size=F.shape)
    expected = np.sum(R_bar * richardson(lambda h: rotation(F + h * dF), 2e-4))
    found = np.sum(rotation_vjp(F, rotation(F), R_bar) * dF)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-11)


@pytest.mark.parametrize("dim", [2, 3])
def test_crushed_material_is_named(dim):
    F = np.tile(np.eye(dim), (4, 2, 1, 1))
    F[3, 1] = np.diag([1.0, 0.5, -0.5][3 - dim :])
    with pytest.raises(CrushedError, match=r"crushed .*indices \(3, 1\)"):
        rotation(F)

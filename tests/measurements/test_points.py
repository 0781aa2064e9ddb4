"""Markers on stems: exact for rigid motion, and an adjoint by dot product."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from cqrun.engine.model import Records
from cqrun.measurements.points import Points, markers, particles


def random_record(rng, dim, steps=5, count=3, strain=0.2):
    F = np.eye(dim) + strain * rng.normal(size=(steps, count, dim, dim))
    x, v = rng.normal(size=(2, steps, count, dim))
    return Records(x, v, rng.normal(size=F.shape), F)


def observed_rows(rows, x, v, C, F):
    """Return the record of one body's particles, each (N, ...) or (T, N, ...), as the engine writes it."""
    return Records(
        *(np.stack([(rows @ a.reshape(len(a), -1)).reshape(-1, *a.shape[1:]) for a in field]) for field in (x, v, C, F))
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_rigid_motion_is_exact_stems_included(dim, rng):
    body = rng.uniform(0, 0.1, (200, dim))
    rest = np.vstack([rng.uniform(-0.03, 0.13, (4, dim)), rng.uniform(0.03, 0.07, (2, dim))])
    observer = markers(rest, body, 0.1 * 200 ** (-1 / dim))
    W = rng.normal(size=(dim, dim))
    W, b = W - W.T, rng.normal(size=dim)
    times = np.linspace(0, 1, 4)
    R = np.stack([expm(t * W) for t in times])
    turn = lambda points: np.einsum("tij,nj->tni", R, points) + times[:, None, None] * b  # noqa: E731
    spin = lambda points: np.einsum("ij,tjk,nk->tni", W, R, points) + b  # noqa: E731
    spread = lambda A: np.broadcast_to(A[:, None], (4, len(body), dim, dim))  # noqa: E731
    record = observed_rows(observer.rows, turn(body), spin(body), spread(np.stack([W] * 4)), spread(R))
    y, w = observer.observe(record)
    np.testing.assert_allclose(y, turn(rest), atol=1e-13)
    np.testing.assert_allclose(w, spin(rest), atol=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("strain", [0.0, 0.2])
def test_adjoint(dim, rng, strain):
    record = random_record(rng, dim, strain=strain)
    observer = Points(rows=None, stems=rng.normal(size=(3, dim)))
    direction = random_record(rng, dim)
    y_bar, w_bar = rng.normal(size=(2, 5, 3, dim))

    def dot(h):
        y, w = observer.observe(Records(*(a + h * d for a, d in zip(record, direction, strict=True))))
        return np.sum(y_bar * y) + np.sum(w_bar * w)

    h = 2e-4
    expected = (8 * (dot(h) - dot(-h)) - (dot(2 * h) - dot(-2 * h))) / (12 * h)
    found = sum(np.sum(a * d) for a, d in zip(observer.observe_vjp(record, y_bar, w_bar), direction, strict=True))
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-10)


def test_without_stems_the_deformation_does_not_matter(rng):
    record = random_record(rng, 2, count=1)
    observer = particles([1], 3)
    y, w = observer.observe(record)
    np.testing.assert_array_equal(y, record.x)
    np.testing.assert_array_equal(w, record.v)
    back = observer.observe_vjp(record, y, w)
    np.testing.assert_array_equal(back.x, record.x)
    np.testing.assert_array_equal(back.v, record.v)
    assert not back.C.any()
    assert not back.F.any()
    np.testing.assert_array_equal(observer.rows.toarray(), [[0, 1, 0]])

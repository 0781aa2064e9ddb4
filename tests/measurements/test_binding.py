"""Where markers stand: symmetric feet, affine fields kept, stems that reach the marker."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.measurements.binding import bind, pick

SPACING = 0.0025


def beam(dim):
    """Return the lattice of a bar with its free end at x = 0."""
    sides = [np.arange(-0.1 + SPACING / 2, 0, SPACING)] + [np.arange(SPACING / 2, 0.03, SPACING)] * (dim - 1)
    return np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, dim)


def test_feet_of_the_real_beams_markers():
    tips = np.array([(0, 0.015, 0.036), (0, -0.006, 0.024), (0, 0.036, 0.006)])
    bound = bind(tips, beam(3), SPACING)
    feet = bound.rows @ beam(3)
    np.testing.assert_allclose(feet + bound.stems, tips, atol=1e-16)
    assert feet[0, 1] == pytest.approx(0.015, abs=1e-15), "equally near particles share the foot"
    surface = np.array([(0, 0.015, 0.03), (0, 0, 0.024), (0, 0.03, 0.006)])
    assert np.abs(feet - surface).max() < 1.5 * SPACING
    assert (bound.rows.data > 0).all()
    assert np.diff(bound.rows.indptr).min() >= 4


@pytest.mark.parametrize("dim", [2, 3])
def test_points_in_the_body_stand_at_themselves(dim, rng):
    particles = beam(dim)
    points = particles[rng.integers(len(particles), size=20)] + rng.uniform(-0.5, 0.5, (20, dim)) * SPACING
    bound = bind(points, particles, SPACING)
    np.testing.assert_allclose(bound.rows.sum(axis=1), 1.0)
    np.testing.assert_allclose(bound.stems, 0.0, atol=1e-15)
    A, b = rng.normal(size=(dim, dim)), rng.normal(size=dim)
    np.testing.assert_allclose(bound.rows @ (particles @ A.T + b), points @ A.T + b, atol=1e-14)
    assert np.abs(bound.rows.data).max() < 1.0


@pytest.mark.parametrize("dim", [2, 3])
def test_affine_fields_at_the_foot(dim, rng):
    particles = beam(dim)
    bound = bind(rng.uniform(-0.05, 0.08, (20, dim)), particles, SPACING)
    A, b = rng.normal(size=(dim, dim)), rng.normal(size=dim)
    feet = bound.rows @ particles
    np.testing.assert_allclose(bound.rows @ (particles @ A.T + b), feet @ A.T + b, atol=1e-14)
    np.testing.assert_allclose(bound.rows.sum(axis=1), 1.0)


def test_a_marker_that_moves_a_little_moves_its_foot_a_little():
    particles, at = beam(3), np.array([-0.05, 0.0137, 0.04])
    feet = [bind(np.add(at, [d, 0, 0]), particles, SPACING).rows @ particles for d in (0, 1e-8)]
    assert np.abs(feet[1] - feet[0]).max() < 3e-8


def test_random_particles_and_a_body_of_one_particle(rng):
    cloud = rng.uniform(0, 1, (300, 2))
    bound = bind(rng.uniform(0.1, 0.9, (10, 2)), cloud, np.sqrt(1 / 300))
    assert np.abs(bound.stems).max() < 0.06
    assert (bind([[1.0, 2.0]], [[0.0, 0.0]], 0.1).stems == [[1.0, 2.0]]).all()


def test_pick(rng):
    x = rng.normal(size=(7, 2))
    np.testing.assert_array_equal(pick([5, 0], 7) @ x, x[[5, 0]])
    for wrong in ([7], [-1]):
        with pytest.raises(ValueError, match="from 0 to 6"):
            pick(wrong, 7)

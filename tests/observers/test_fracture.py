"""Numerical fracture: pairs of neighbours at rest are counted as lost once they share no node."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from cqrun.observers.fracture import Fracture

DX = 0.1


def block(dim: int, per_axis: int = 6) -> np.ndarray:
    """Return a lattice of spacing DX / 2."""
    axis = 0.2 + (np.arange(per_axis) + 0.5) * DX / 2
    return np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(-1, dim)


def watch(x: np.ndarray, **bodies: slice) -> Fracture:
    bodies = bodies or {"body": slice(0, len(x))}
    return Fracture.of(x, bodies, dict.fromkeys(bodies, DX / 2), DX)


def nodes(x: np.ndarray) -> set[tuple[int, ...]]:
    """Return the nodes that a particle's spline reaches, by its definition."""
    near = [[i for i in range(-5, 60) if abs(c / DX - i) < 1.5] for c in x]
    return set(itertools.product(*near))


@pytest.mark.parametrize(("dim", "neighbours"), [(2, 8), (3, 18)])
def test_neighbours_lie_along_axes_and_face_diagonals(dim, neighbours):
    pairs = watch(block(dim)).pairs["body"]
    inner = np.flatnonzero(np.all(np.abs(block(dim) - block(dim).mean(0)) < 0.6 * DX, axis=1))
    counts = np.bincount(pairs.ravel())
    assert np.all(counts[inner] == neighbours)


def test_rigid_translation_loses_no_pair():
    x = block(2)
    fracture = watch(x)
    assert fracture.count(x) == {"body": 0}
    assert fracture.count(x + np.array([1.234, -0.05])) == {"body": 0}
    assert fracture.findings() == []


@pytest.mark.parametrize("dim", [2, 3])
def test_count_is_the_number_of_pairs_without_a_common_node(dim, rng):
    x = block(dim)
    fracture = watch(x)
    torn = x * 5.0 + rng.normal(size=x.shape) * 0.1 * DX + 1.0
    expected = sum(not nodes(torn[i]) & nodes(torn[j]) for i, j in fracture.pairs["body"])
    assert 0 < expected < len(fracture.pairs["body"])
    assert fracture.count(torn) == {"body": expected}


def test_largest_count_is_stored_and_reported_by_body():
    x = np.concatenate([block(2), block(2) + np.array([1.0, 0.0])])
    half = len(x) // 2
    fracture = watch(x, left=slice(0, half), right=slice(half, None))
    torn = x.copy()
    torn[half:, 0] += np.where(x[half:, 0] > x[half:, 0].mean(), 3 * DX, 0.0)
    lost = fracture.count(torn)
    assert lost["left"] == 0
    assert lost["right"] == 6 + 2 * 5  # the pairs across the cut: straight, and on the diagonals
    fracture.count(x)
    assert fracture.most == lost
    (sentence,) = fracture.findings()
    assert sentence.startswith("numerical fracture: 16 of ")
    assert "the body 'right'" in sentence


def test_particles_too_far_apart_at_rest_are_not_neighbours():
    """Where the lattice is wider than the grid, pairs that never shared a node are not counted as lost."""
    x = block(2) * 5.0
    fracture = Fracture.of(x, {"body": slice(0, len(x))}, {"body": 2.5 * DX}, DX)
    assert fracture.count(x) == {"body": 0}

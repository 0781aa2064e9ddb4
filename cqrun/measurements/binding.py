"""Bind markers to a body: each marker has a foot among the particles at rest, and a stem from the foot.

The foot is a weighted mean of the particles nearest to the marker. The weights decrease smoothly
with distance, so the foot is in the middle of particles that are equally near. If a marker is inside
the body, the foot is the marker itself: moving least squares corrects the weights, so that they are
exact for affine fields at this point. In both cases foot = rows @ x, and affine motion moves it affinely.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cqrun.observers.rows import single, weighted
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

REACH = 1.5
"""Width of the weights, in particle spacings."""

_CUT = 1e-6


@dataclass(frozen=True)
class Binding:
    """M points bound to a body.

    Attributes:
        rows: (M, N) sparse weights; every row sums to 1; foot = rows @ particles.
        stems: (M, D) vectors from the foot to the point, at rest [m].
    """

    rows: csr_array
    stems: Array


def bind(points: Array, particles: Array, spacing: float) -> Binding:
    """Bind points (M, D) to the body whose particles (N, D) are at rest.

    Args:
        points: rest positions [m]; a point outside the body has a stem.
        particles: positions of the body's particles [m].
        spacing: mean distance of particles, (volume of the body / N)**(1/D) [m].
    """
    points, particles = np.atleast_2d(points).astype(float), np.asarray(particles, dtype=float)
    inside = 0.5 * np.sqrt(particles.shape[1]) * spacing * (1 + 1e-9)
    found = [_weights(point, particles, spacing, inside) for point in points]
    rows = weighted([index for index, _ in found], [weight for _, weight in found], len(particles))
    return Binding(rows, points - rows @ particles)


def pick(indices: Array, count: int) -> csr_array:
    """Return rows (len(indices), count) that select single particles."""
    index = np.asarray(indices, dtype=int)
    if index.size and (index.min() < 0 or index.max() >= count):
        raise ValueError(f"particle indices must be from 0 to {count - 1}")
    return single(index, count)


def _weights(point: Array, particles: Array, spacing: float, inside: float) -> tuple[Array, Array]:
    """Return the indices of the particles that carry a point, and their weights, which sum to 1."""
    squared = ((particles - point) ** 2).sum(axis=1)
    nearest = squared.min()
    power = (squared - nearest) / (REACH * spacing) ** 2
    (index,) = np.nonzero(power < -np.log(_CUT))
    weight = np.exp(-power[index])
    weight /= weight.sum()
    if nearest <= inside**2:
        offset = particles[index] - weight @ particles[index]
        moment = (weight[:, None] * offset).T @ offset
        slope = np.linalg.pinv(moment, rcond=1e-6) @ (point - weight @ particles[index])
        weight = weight * (1.0 + offset @ slope)
    return index, weight / weight.sum()

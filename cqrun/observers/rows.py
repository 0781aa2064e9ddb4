"""Rows of weights over particles: the weighted sums that a plug-in asks the engine to record.

A row w (N,) gives sum_p w_p (x, v, C, F)_p at every control step. The adjoint takes the sum's cotangent back to the
particles.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def weighted(indices: Sequence[Array], weights: Sequence[Array], n: int) -> csr_array:
    """Return one row over n particles for each pair of indices and weights."""
    from scipy.sparse import csr_array

    starts = np.cumsum([0, *(len(index) for index in indices)])
    columns = np.concatenate([np.zeros(0, int), *indices])
    data = np.concatenate([np.zeros(0), *weights])
    return csr_array((data, columns, starts), shape=(len(indices), n))


def means(sets: Sequence[Array], n: int) -> csr_array:
    """Return one row for each set of particles: their plain mean, as in both papers."""
    return weighted(sets, [np.full(len(chosen), 1.0 / len(chosen)) for chosen in sets], n)


def single(indices: Array, n: int) -> csr_array:
    """Return one row for each of these particles, with weight 1 for it alone."""
    return weighted(list(indices[:, None]), [np.ones(1)] * len(indices), n)


def stacked(parts: Sequence[csr_array], n: int) -> csr_array:
    """Stack the rows of all parts, one below the other."""
    from scipy.sparse import csr_array, vstack

    return csr_array(vstack(parts)) if parts else weighted([], [], n)


def slices(sizes: Sequence[int]) -> list[slice]:
    """Return the slices of parts of these sizes, one after another."""
    ends = np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

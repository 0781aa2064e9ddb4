"""Which particles forces pull, and in which lanes they lie."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.forces.force import Shares
from cqrun.plugin.contract import Array


class Pulled(NamedTuple):
    """The particles that forces pull, and the shares that each of them sums."""

    columns: Array  # (P,) increasing
    begin: Array  # (P + 1,) where the shares of a particle begin in `order`
    order: Array  # (S,) the shares of each particle in the order of their sum
    shares: Shares  # of all kinds of force
    base: Array  # (P, D) steady force on each particle [N]


class PulledLanes(NamedTuple):
    """The lanes of a group with particles that forces pull."""

    first: Array  # (L,) first column of each lane, increasing
    begin: Array  # (L + 1,) where the particles of each lane begin in `Pulled.columns`


def make_pulled(shares: Shares) -> Pulled:
    """Return the particles that the shares pull, in the order of their columns."""
    columns, order = np.unique(shares.columns), np.argsort(shares.columns, kind="stable")
    begin = np.append(np.searchsorted(shares.columns[order], columns), len(order))
    base = np.zeros((len(columns), shares.force.shape[1]))
    return Pulled(columns.astype(np.int64), begin.astype(np.int64), order.astype(np.int64), shares, base)


def pulled_lanes(columns: Array, lo: int, hi: int, width: int) -> PulledLanes:
    """Return the lanes of the group with the columns lo .. hi."""
    first, last = np.searchsorted(columns, [lo, hi])
    lanes = np.unique(columns[first:last] // width) * width
    return PulledLanes(lanes.astype(np.int64), np.searchsorted(columns, [*lanes, hi]).astype(np.int64))

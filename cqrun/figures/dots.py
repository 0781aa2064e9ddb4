"""Particles as dots that look like a solid body."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from cqrun.contract import Array
from cqrun.figures.views import View

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection

COVER = 1.5
"""Diameter of a dot in distances between particles: the diagonal of a square lattice, and some stretch."""


def spacings(x: Array, bodies: Mapping[str, slice]) -> Array:
    """Return the distance between a particle and those next to it (N,) [m], at positions x (N, D).

    It is that of the 2D-th nearest, which on a lattice is its spacing and of random particles about its mean; since
    that one is far at edges, the least among a particle and the 4D around it. A lone particle gets the others' mean.
    """
    from scipy.spatial import cKDTree

    out = np.full(len(x), np.nan)
    for part in bodies.values():
        own = x[part]
        if len(own) < 2:
            continue
        beside, around = (min(n * x.shape[1], len(own) - 1) for n in (2, 4))
        distance, near = cKDTree(own).query(own, k=around + 1)
        out[part] = distance[:, beside][near].min(axis=1)
    known = out[np.nan_to_num(out) > 0]
    fallback = float(known.mean()) if known.size else 0.02 * max(float(np.abs(x).max()), 1e-9)
    return np.where(np.nan_to_num(out) > 0, out, fallback)


def add_dots(axes: Axes, size: Array, *, cover: float = COVER, edge: float = 0.0) -> EllipseCollection:
    """Add a dot for each particle to axes, to be placed by `set_offsets`.

    Args:
        size: distance between particles (N,), in the axes' unit.
        cover: diameter in those distances.
        edge: width of the white line around a dot [points]; it tells near dots from far ones.
    """
    from matplotlib.collections import EllipseCollection

    dots = EllipseCollection(
        cover * size, cover * size, np.zeros(len(size)), units="xy", offsets=np.zeros((len(size), 2)),
        offset_transform=axes.transData, rasterized=True, edgecolors="white", linewidths=edge,
    )  # fmt: skip
    axes.add_collection(dots)
    return dots


def far_to_near(x: Array, look: View) -> Array:
    """Return the order in which particles x (N, D) are drawn, so that near ones cover far ones."""
    return np.argsort(x @ look.towards, kind="stable")

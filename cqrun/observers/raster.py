"""A body on a grid of cells that moves with it: an image for a convolutional network, and the adjoint.

The channels of a cell are the share of the particles in it times the number of cells, and the sum of their velocities
with the same factor. Quadratic B-splines spread a particle over the cells near it, so the image is smooth in the
positions. Particles outside the grid are counted in its outermost cells. The grid is centred on the particles' plain
mean.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class Raster:
    """A grid of `cells` along each axis, of edge `cell` [m]; velocities are divided by `speed` [m/s]."""

    cells: int
    cell: float
    speed: float
    dim: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Channels, then cells along each axis."""
        return (1 + self.dim, *(self.cells,) * self.dim)

    def image(self, x: Array, v: Array) -> Array:
        """Return the channels (1 + D, G, ...) of particles at x, v (n, D) [m], [m/s]."""
        carried = self._carried(v)
        out = np.zeros((1 + self.dim, self.cells**self.dim), np.result_type(x, v))
        for cell, weight, _ in self._stencil(x):
            for channel, value in zip(out, carried, strict=True):
                np.add.at(channel, cell, weight * value)
        return out.reshape(self.shape)

    def image_vjp(self, x: Array, v: Array, image_bar: Array) -> tuple[Array, Array]:
        """Return the cotangents of x and v from that of the image."""
        carried, bar = self._carried(v), image_bar.reshape(1 + self.dim, -1)
        carried_bar, y_bar = np.zeros_like(carried), np.zeros_like(x)
        for cell, weight, slopes in self._stencil(x):
            at_cell = bar[:, cell]
            carried_bar += weight * at_cell
            y_bar += slopes * (at_cell * carried).sum(axis=0)[:, None]
        # the grid moves with the mean of x
        x_bar = (y_bar - y_bar.mean(axis=0)) / self.cell
        return x_bar, carried_bar[1:].T * self._share(len(x)) / self.speed

    def _share(self, n: int) -> float:
        return self.cells**self.dim / n

    def _carried(self, v: Array) -> Array:
        """Return what each particle adds to its cells (1 + D, n)."""
        return np.concatenate([np.ones((1, len(v))), v.T / self.speed]) * self._share(len(v))

    def _stencil(self, x: Array) -> list[tuple[Array, Array, Array]]:
        """Return for each of the 3^D cells around a particle: cell (n,), weight (n,), d weight / dy (n, D) in cells."""
        y = (x - x.mean(axis=0)) / self.cell + 0.5 * (self.cells - 1)
        base = np.floor(y.real + 0.5).astype(int) - 1
        f = y - base
        W = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
        S = np.stack([f - 1.5, 2.0 - 2.0 * f, f - 0.5])
        out = []
        for offset in itertools.product(range(3), repeat=self.dim):
            place = np.clip(base + offset, 0, self.cells - 1)
            factors = [W[o, :, d] for d, o in enumerate(offset)]
            slopes = [
                S[o, :, d] * np.prod([g for e, g in enumerate(factors) if e != d], axis=0) for d, o in enumerate(offset)
            ]
            cell = np.ravel_multi_index(tuple(place.T), (self.cells,) * self.dim)
            out.append((cell, np.prod(factors, axis=0), np.stack(slopes, axis=1)))
        return out

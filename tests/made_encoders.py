"""Encoders with random weights, for tests of observers."""

from __future__ import annotations

import numpy as np

from cqrun.observers.encoder import Encoder, size_after
from cqrun.observers.raster import Raster
from cqrun.observers.vae import Trained


def made_encoder(dim: int, rng: np.random.Generator, cells: int = 5) -> Trained:
    """Return an encoder with random weights for a grid of 5 cells."""
    kernels = tuple(rng.normal(size=(c_out, c_in, *(3,) * dim)) * 0.4 for c_in, c_out in ((1 + dim, 4), (4, 3)))
    n = 3 * size_after(size_after(cells)) ** dim
    ends = (rng.normal(size=(2, n)), rng.normal(size=2), rng.normal(size=1 + dim))
    encoder = Encoder(kernels, (rng.normal(size=4), rng.normal(size=3)), *ends)
    return Trained(Raster(cells, 0.25, 2.0, dim), encoder)

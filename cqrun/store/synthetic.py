"""Synthetic data: marker tracks of a known truth with added noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array


def make_synthetic(
    time: Array,
    names: Sequence[str],
    positions: Array,
    *,
    noise: float,
    copies: int,
    rng: np.random.Generator,
    source: str = "synthetic",
) -> list[Recording]:
    """Return `copies` recordings of the same motion, each with different noise.

    Args:
        time: times (T,) [s].
        names: names of the M markers.
        positions: true positions in the scene's frame (T, M, D) [m].
        noise: standard deviation of the white Gaussian noise on every coordinate [m].
        copies: number of recordings.
        rng: random generator of the noise; the copies are drawn one after another.
        source: name of the recordings in error messages.

    Raises:
        ValueError: the noise is negative, there are no copies, or the shapes do not fit.
    """
    if noise < 0 or copies < 1:
        raise ValueError(f"noise {noise:g} must not be negative and copies {copies} must be 1 or more")
    exact = np.asarray(positions, dtype=float)
    if exact.shape[:2] != (len(time), len(names)):
        raise ValueError(f"positions {exact.shape} do not fit {len(time)} times and {len(names)} markers")
    return [
        Recording(
            np.asarray(time, dtype=float),
            tuple(names),
            exact + noise * rng.standard_normal(exact.shape),
            f"{source} copy {copy}",
        )
        for copy in range(copies)
    ]

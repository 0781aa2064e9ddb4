"""Data that cqrun makes for itself: marker tracks of a known truth, with noise."""

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
    """Return `copies` recordings of the same motion, each with its own noise.

    Args:
        time: (T,) [s].
        names: M markers.
        positions: (T, M, D) of the truth, in the scene's frame [m].
        noise: standard deviation of the white Gaussian noise on every coordinate [m].
        rng: where the noise comes from; the copies are drawn one after the other.
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

"""A recording of a beam that is let go and swings, made by a formula: its rhythm and its held end are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cqrun.measurements.recording import Recording

RELEASE, PERIOD, SAG = 0.5, 0.2, 6e-3
"""When it is let go [s], its period [s], and how far its tip sinks in the end [m]."""

HELD, FREE = ("base_1", "base_2", "base_3"), ("tip_1", "tip_2", "tip_3")
PLACES = np.array(
    [[0, 0, 0], [0, 0.03, 0], [0, 0.03, 0.03], [0.1, 0, 0], [0.1, 0.03, 0], [0.1, 0.015, 0.03]]
)  # fmt: skip
"""Where the markers HELD and FREE are at rest [m]."""


def swing(
    *, duration: float = 3.0, rate: float = 200.0, noise: float = 1e-5, down: Sequence[float] = (0, 0, -1),
    degrees: float = 0.0, at: Sequence[float] = (0.2, -0.3, 0.5), release: float = RELEASE, base: float = 0.0,
) -> Recording:  # fmt: skip
    """Return a recording of the six markers in 3D.

    Args:
        down: the direction in which the tip sinks.
        degrees: by which the beam is turned about z, to which `down` belongs.
        at: position of the marker base_1 [m].
        base: how far the held end moves, as a part of the tip.
    """
    time = np.arange(0.0, duration, 1.0 / rate)
    t = np.maximum(time - release, 0.0)
    sag = SAG * (1.0 - np.exp(-2.0 * t) * np.cos(2 * np.pi * t / PERIOD))
    share = np.array([base] * 3 + [1.0] * 3)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x = PLACES @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + np.array(at)
    x = x + sag[:, None, None] * share[:, None] * np.array(down, float)
    x = x + noise * np.random.default_rng(3).normal(size=x.shape)
    return Recording(time, HELD + FREE, x, "made")

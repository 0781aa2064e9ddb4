"""Whether a controller feels what it sees: how far its observations move of the range that becomes [-1, 1].

A network's first weights are for inputs of about 1. What moves by a few hundredths steers it as little: a robot that
could walk learns to stand, and nothing else tells why.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cqrun.observers.observer import Observation
from cqrun.plugin.contract import Array

LEAST = 0.05
"""Standard deviation over an episode, of half the range, that numbers should have (root of the mean square)."""


def faint(observation: Observation, saw: Sequence[Array]) -> Iterator[str]:
    """Yield a sentence on every observer of which no kind moved by LEAST in any episode; what stood still is none.

    Numbers of one range are a kind, such as velocities: one leg that swings does not speak for forty parts that do not.

    Args:
        observation: what was seen, and its ranges.
        saw: what the controller got, (T, Z) an episode.
    """
    if not saw:  # an evaluation that was only read again
        return
    moved = np.max([z.std(axis=0) for z in saw], axis=0)
    for name, place in observation.parts.items():
        ranges = np.stack([observation.middle[place], observation.half[place]], axis=1)
        kinds = np.unique(ranges, axis=0)
        sizes = [float(np.sqrt(np.mean(moved[place][(ranges == kind).all(axis=1)] ** 2))) for kind in kinds]
        if not 0 < max(sizes, default=0.0) < LEAST:
            continue
        told = [
            f"{half * size:.2g} of the range {middle - half:g} to {middle + half:g}"
            for (middle, half), size in zip(kinds, sizes, strict=True)
        ]
        yield (
            f"observers.{name}: the controller hardly feels it: at the start it moves by {', by '.join(told)} "
            "(standard deviation). A narrower `range` may be what it needs to learn"
        )

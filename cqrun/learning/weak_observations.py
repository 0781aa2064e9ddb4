"""Find weak observations: they use only a small part of the range that is mapped to [-1, 1].

The first weights of a network are made for inputs of about 1. Observations that move by a few hundredths hardly change
its output: a robot that could walk learns to stand, and nothing else shows why.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cqrun.observers.observer import Observation
from cqrun.plugin.contract import Array

LEAST = 0.05
"""Least standard deviation over an episode (root mean square), in halves of the range."""


def weak_observations(observation: Observation, inputs: Sequence[Array]) -> Iterator[str]:
    """Yield a sentence on every observer that moves, but none of whose kinds moves by LEAST in any episode.

    Numbers with the same range are a kind, such as velocities; one swinging leg does not stand for forty parts at rest.

    Args:
        observation: the observers and their ranges.
        inputs: (T, Z) inputs of the controller, for each episode.
    """
    if not inputs:  # the evaluation was read from the history
        return
    moved = np.max([z.std(axis=0) for z in inputs], axis=0)
    for name, place in observation.parts.items():
        ranges = np.stack([observation.middle[place], observation.half[place]], axis=1)
        kinds = np.unique(ranges, axis=0)
        sizes = [float(np.sqrt(np.mean(moved[place][(ranges == kind).all(axis=1)] ** 2))) for kind in kinds]
        if not 0 < max(sizes, default=0.0) < LEAST:
            continue
        parts = [
            f"{half * size:.2g} of the range {middle - half:g} to {middle + half:g}"
            for (middle, half), size in zip(kinds, sizes, strict=True)
        ]
        yield (
            f"observers.{name}: hardly changes the controller's output: at the start it moves by {', by '.join(parts)} "
            "(standard deviation). A narrower `range` may help the controller to learn"
        )

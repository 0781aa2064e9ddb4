"""Whether a controller feels what it sees: how far its observations move of the range that becomes [-1, 1].

A network's first weights are for inputs of about 1. What moves by a few hundredths steers it as little: a robot that
could walk learns to stand, and nothing else tells why.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cqrun.contract import Array
from cqrun.observers.observer import Observation

LEAST = 0.1
"""Standard deviation over an episode that some observation should have, of half its range."""


def faint(observation: Observation, saw: Sequence[Array]) -> str | None:
    """Return a sentence if no observation moved by LEAST or more in any episode; None if one did, or none moved.

    Args:
        observation: what was seen, and its ranges.
        saw: what the controller got, (T, Z) an episode.
    """
    moved = np.max([z.std(axis=0) for z in saw], axis=0, initial=0.0)
    if not 0 < moved.max(initial=0.0) < LEAST:
        return None
    told = []
    for name, place in observation.parts.items():
        ranges = np.stack([observation.middle[place], observation.half[place]], axis=1)
        for middle, half in np.unique(ranges, axis=0):
            most = half * moved[place][(ranges == (middle, half)).all(axis=1)].max()
            told.append(f"observers.{name}: {most:.2g} where {middle - half:g} to {middle + half:g} become [-1, 1]")
    return (
        f"the controller hardly feels what it sees; at the start it moves by (standard deviation) {'; '.join(told)}. "
        "A narrower `range` may be what it needs to learn"
    )

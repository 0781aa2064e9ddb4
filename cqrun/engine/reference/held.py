"""Which nodes of the bodies the boundary conditions hold, at rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cqrun.engine.model import ConditionModel
from cqrun.plugin.contract import Array


class Held(NamedTuple):
    """The conditions of each node.

    `bits` (M,) has bit k set if condition k applies to the node; `normals` has the unit normals (M, D) of the
    conditions with one for each node, by the number of the condition.
    """

    bits: Array
    normals: dict[int, Array]


def held_nodes(conditions: Sequence[ConditionModel], X: Array) -> Held:
    """Return which nodes at rest at X (M, D) [m] the conditions hold."""
    bits, normals = np.zeros(len(X), np.int64), {}
    for k, condition in enumerate(conditions):
        inside, normal = condition.at(X)
        bits |= inside.astype(np.int64) << k
        if not isinstance(normal, tuple):
            normals[k] = np.ascontiguousarray(normal)
    return Held(bits, normals)

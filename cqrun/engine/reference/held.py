"""Which nodes of the bodies the boundary conditions hold, at rest."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
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


def held_nodes(conditions: Sequence[ConditionModel], X: Array, size: Array) -> Held:
    """Return which nodes the conditions hold; obstacles hold none.

    Args:
        X: positions of the nodes at rest (M, D) [m].
        size: of the world (D,) [m].
    """
    bits, normals = np.zeros(len(X), np.int64), {}
    for _, planes in groupby(enumerate(conditions), key=lambda item: item[1].name):
        numbers, own = zip(*planes, strict=True)
        if own[0].spec.is_obstacle:
            continue
        for k, (inside, normal) in zip(numbers, own[0].spec.places(X, size), strict=True):
            bits |= inside.astype(np.int64) << k
            if not isinstance(normal, tuple):
                normals[k] = np.ascontiguousarray(normal)
    return Held(bits, normals)

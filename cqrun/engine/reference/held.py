"""Which nodes of the bodies the boundary conditions hold, at rest."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from cqrun.engine.model import ConditionModel, Model
from cqrun.engine.reference.patches import Patches
from cqrun.engine.setting import MARGIN
from cqrun.plugin.contract import Array


class Held(NamedTuple):
    """The conditions of each node.

    `bits` (M,) has bit k set if condition k applies to the node; `normals` has the unit normals (M, D) of the
    conditions with one for each node, by the number of the condition.
    """

    bits: Array
    normals: dict[int, Array]


def held_nodes(model: Model, patches: Patches) -> Held:
    """Return which nodes of the bodies the conditions of a model hold.

    Nodes of the world's grid are known. Those beyond it have the conditions of the nearest node. The nodes of a body
    whose grid is shifted have places of their own.
    """
    X, own, shape = patches.positions(model.dx), patches.offset[patches.body_of_nodes()], np.array(model.grid_shape)
    place = np.clip(np.rint((X - own) / model.dx).astype(int) + MARGIN, 0, shape - 1)
    number, shifted = np.ravel_multi_index(place.T, shape), own.any(axis=1)
    bits = model.condition_bits()[number]
    normals = {
        k: np.ascontiguousarray(condition.normal[number])
        for k, condition in enumerate(model.conditions)
        if not isinstance(condition.normal, tuple)
    }
    if shifted.any():
        there = held_at(model.conditions, X[shifted], model.size)
        bits[shifted] = there.bits
        for k, normal in there.normals.items():
            normals[k][shifted] = normal
    return Held(bits, normals)


def held_at(conditions: Sequence[ConditionModel], X: Array, size: Array) -> Held:
    """Return which places the conditions of a scene hold. Obstacles hold none: bodies touch them.

    Args:
        X: places at rest (M, D) [m].
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
                normals[k] = normal
    return Held(bits, normals)

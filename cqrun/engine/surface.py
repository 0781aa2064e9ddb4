"""What bodies of the reference frame touch with, and what they touch: surfaces and obstacles, parts of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cqrun.boundaries.solid import Solid
from cqrun.engine.rigid_model import RigidModel, count_skin
from cqrun.plugin.contract import Array

NO_FACETS = np.zeros((0, 0), np.int64)


@dataclass(frozen=True)
class SurfaceModel:
    """Points on the surfaces of all bodies at rest, body after body.

    Attributes:
        x: positions (S, D) [m].
        particle: the nearest particle of the same body, in user order (S,); a point moves with it.
        stiffness: of the penalty, times the area that a point stands for (S,) [N/m].
        impedance: of the material, times that area (S,) [N s/m]: what a dashpot of 1 has.
        area: of a point (S,) [m^(D-1)].
        facets: (T, D) the points of each segment or triangle (`geometry/skin.py`).
    """

    x: Array
    particle: Array
    stiffness: Array
    impedance: Array
    area: Array
    facets: Array = field(default_factory=lambda: NO_FACETS)


@dataclass(frozen=True)
class ObstacleModel:
    """A boundary that bodies touch: the union of solids.

    `condition` is its number among `Model.conditions`, which has the coefficient of friction; `rubs` says whether it
    has friction. `dashpot` is that along the normal, as a part of the impedance.
    """

    condition: int
    solids: tuple[Solid, ...]
    rubs: bool
    dashpot: float = 0.0


@dataclass(frozen=True)
class MeetingModel:
    """How bodies meet each other: with friction if `rubs`, and with a dashpot as a part of the impedance.

    The coefficient of friction follows those of the conditions in `Inputs.coefficients`.
    """

    rubs: bool = False
    dashpot: float = 0.0


def count_springs(
    surface: SurfaceModel | None, obstacles: Sequence[ObstacleModel], meeting: MeetingModel | None,
    rigid: Sequence[RigidModel] = (),
) -> tuple[int, int, int]:  # fmt: skip
    """Return the numbers of tangential springs, which are part of the state, in their order.

    They are those of soft surfaces on obstacles and rigid bodies, of the skins of rigid bodies on obstacles, and of
    soft surfaces on each other.
    """
    if surface is None:
        return 0, 0, 0
    rubs = any(obstacle.rubs for obstacle in obstacles)
    on_obstacles = rubs or any(body.rubs for body in rigid)
    meet = meeting is not None and meeting.rubs
    return len(surface.x) * on_obstacles, count_skin(rigid) * rubs, len(surface.x) * meet

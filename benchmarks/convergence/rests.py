"""Equilibria of scenes, as `cqrun rest` finds them."""

from __future__ import annotations

from dataclasses import dataclass

from cqrun.build.load_path import inputs_of, points_of
from cqrun.build.model import Built
from cqrun.engine.statics.path import RestPath
from cqrun.state import State

TOLERANCE = 1e-7
"""Net force over the load at which an equilibrium is found; rounding is 2e-8 for a slender beam at nu 0.499."""


@dataclass(frozen=True)
class Found:
    """The state of the particles at the last point of a scene's path, and the products with the stiffness matrix."""

    state: State
    products: int


def last_rest(built: Built) -> Found:
    """Return the equilibrium at the last point of the scene's path, or under its loads if it has none.

    Raises:
        ValueError: no equilibrium is found.
    """
    points = points_of(built)
    path = RestPath(built.model, [inputs_of(built, point) for point in points], tolerance=TOLERANCE)
    path.run()
    last = path.points[-1]
    if len(path.points) < len(points) or not last.rest.converged:
        raise ValueError(f"no equilibrium at point {len(path.points)}: residual {last.rest.residual:.1e}")
    return Found(path.start.state(last.rest.u), sum(point.products for point in path.points))

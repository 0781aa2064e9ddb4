"""How far a body's centroid is from a goal at one time."""

from __future__ import annotations

import numpy as np

from cqrun.engine.model import Records
from cqrun.fitting.points import Points
from cqrun.objectives.hermite import interpolant
from cqrun.plugin.contract import Array


class TargetObjective:
    """Squared distance of an observed point from a goal [m^2]."""

    def __init__(self, observer: Points, goal: Array, *, time: float, control_step: float, steps: int) -> None:
        """Fix goal and time.

        Args:
            observer: of one point, as `observers.markers.centroid` gives it.
            goal: (D,) [m].
            time: since the start of the rollout [s]; between control steps by cubic Hermite.

        Raises:
            ValueError: the time is before the start or after the end of the rollout.
        """
        if time < 0:
            raise ValueError(f"the target's time is {time:g} s; it must not be negative")
        self.observer, self.goal = observer, np.asarray(goal, dtype=float)
        self.at = interpolant(np.array([time]), control_step, steps)

    def position(self, record: Records) -> Array:
        """Return where the point is at the target's time, (D,) [m]."""
        return np.asarray(self.at(*self.observer.observe(record))[0, 0])

    def residuals(self, record: Records) -> Array:
        """Return position less goal, (D,) [m]."""
        return self.position(record) - self.goal

    def loss(self, record: Records) -> float:
        """Return the squared distance [m^2]."""
        return float(np.sum(self.residuals(record) ** 2))

    def loss_vjp(self, record: Records, loss_bar: float = 1.0) -> Records:
        """Return the cotangent of the record from that of the loss."""
        out_bar = 2.0 * loss_bar * self.residuals(record)
        return self.observer.observe_vjp(record, *self.at.vjp(out_bar[None, None]))

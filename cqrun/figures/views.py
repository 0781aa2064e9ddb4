"""The views of a picture, and the windows that they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.errors import UsageError
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

TURN, TILT = 30.0, 20.0
"""Angles of the oblique view: turn about the vertical, and tilt from above [degrees]."""

MARGIN = 0.05
"""Free margin around the bodies, as a part of their extent."""

NEARLY = 0.9
"""Sides at least this part of the longest count as equally long; then the first axis is drawn across."""


@dataclass(frozen=True)
class View:
    """An orthographic view of the world.

    Attributes:
        axes: unit vectors to the right and upwards in the picture (2, D).
        names: names of these two axes; empty for an oblique view, which has no ticks. An axis of the world may point
            left or down in the picture.
    """

    axes: Array
    names: str = ""

    @property
    def towards(self) -> Array:
        """Unit vector towards the eye (D,); zero in 2D."""
        return np.cross(*self.axes) if self.axes.shape[1] == 3 else np.zeros(2)


PLANE = View(np.eye(2), "xy")
"""The view of a 2D world."""


def views(scene: Scene, x: Array) -> list[View]:
    """Return the views of positions x (..., D): the plane itself in 2D, from the side and oblique in 3D."""
    return [PLANE] if scene.dim == 2 else [view(scene, x, "side"), view(scene, x, "iso")]


def view(scene: Scene, x: Array, name: str) -> View:
    """Return one of the views in `choices.Look` of positions x (..., 3).

    Up is opposite to the largest component of gravity, or z without gravity. The side view shows the longest side of
    the bodies.

    Raises:
        UsageError: the world is 2D, which has only one view.
    """
    if scene.dim == 2:
        raise UsageError(f"--view {name}: the world of this run has two dimensions, so it has only one view")
    axes = np.eye(3)
    gravity = np.array(scene.world.gravity)
    up = int(np.argmax(np.abs(gravity))) if gravity.any() else 2
    upward = -axes[up] if gravity[up] > 0 else axes[up]
    extent = np.ptp(x.reshape(-1, 3), axis=0)
    sides = [axis for axis in range(3) if axis != up]
    across = next(axis for axis in sides if extent[axis] >= NEARLY * max(extent[sides]))
    deep = 3 - up - across
    side = View(np.stack([axes[across], upward]), "xyz"[across] + "xyz"[up])
    back = -side.towards
    if name == "side":
        return side
    if name == "front":  # the eye stands where `across` grows
        return View(np.stack([np.cross(upward, axes[across]), upward]), "xyz"[deep] + "xyz"[up])
    if name == "top":
        return View(np.stack([axes[across], np.cross(upward, axes[across])]), "xyz"[across] + "xyz"[deep])
    turn, tilt = np.radians(TURN), np.radians(TILT)
    right = np.cos(turn) * axes[across] + np.sin(turn) * back
    away = np.cos(turn) * back - np.sin(turn) * axes[across]
    return View(np.stack([right, np.cos(tilt) * upward + np.sin(tilt) * away]))


def window(x: Array, look: View, room: float) -> Array:
    """Return the window that shows positions x (..., D) with a margin `room` [m]: lower and upper corner (2, 2) [m]."""
    plane = x.reshape(-1, x.shape[-1]) @ look.axes.T
    return np.array([plane.min(axis=0) - room, plane.max(axis=0) + room])


def room_around(x: Array, size: Array) -> float:
    """Return the margin to leave around particles at x (..., D) with a size (N,) [m]."""
    return MARGIN * float(np.max(np.ptp(x.reshape(-1, x.shape[-1]), axis=0))) + float(size.max())


def of_equal_width(windows: Sequence[Array]) -> list[Array]:
    """Return windows with the same middles and the width of the widest, so that all have the same scale."""
    widest = max(float(w[1, 0] - w[0, 0]) for w in windows)
    out = []
    for corners in windows:
        more = 0.5 * (widest - float(corners[1, 0] - corners[0, 0]))
        out.append(corners + np.array([[-more, 0.0], [more, 0.0]]))
    return out

"""The fixed parts in a picture of bodies: boundaries, goals and axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.build.regions import boundary
from cqrun.figures.style import GREY, GROUND, INK, TRUTH
from cqrun.figures.views import View, room_around
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene
from cqrun.units import Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PIXELS = 240
"""Number of samples along the longer side of the view, at which boundaries are evaluated."""


LABELS_RIGHT = 0.7
"""Names are to the right of goals in this left part of a picture, and to the left of goals in the rest."""


@dataclass(frozen=True)
class Goal:
    """A position to reach.

    Attributes:
        name: name in the scene.
        position: (D,) [m].
        spread: half the range from which it is drawn (D,) [m]; zero if it is fixed.
        course: positions to pass before it (K, D) [m].
    """

    name: str
    position: Array
    spread: Array
    course: Array = field(default_factory=lambda: np.zeros((0, 0)))


def goals(scene: Scene, provenance: Mapping[str, Any] | None = None) -> list[Goal]:
    """Return the goals of a scene, and the courses of its objective.

    Args:
        scene: the scene.
        provenance: attributes of the trajectory: `goals` are the drawn positions of goals in this run (D,) [m], and
            `courses` positions to pass (K, D) [m]; both by name.
    """
    result = []
    drawn: Mapping[str, Any] = (provenance or {}).get("goals") or {}
    no_spread = np.zeros(scene.dim)
    for name, goal in scene.goals.items():
        if name in drawn:
            result.append(Goal(name, np.array(drawn[name]), no_spread))
        else:
            spread = no_spread if goal.spread is None else np.array(goal.spread)
            result.append(Goal(name, np.array(goal.position), spread))
    for name, course in ((provenance or {}).get("courses") or {}).items():
        result.append(Goal(name, np.array(course[-1]), no_spread, np.array(course)))
    return result


def window_with_goals(plane: Array, look: View, marked: Sequence[Goal], size: Array) -> Array:
    """Return the window that contains bodies and goals, with the goals' ranges and courses (2, 2) [m].

    Args:
        plane: points of the bodies in the plane of the view (n, 2) [m].
        look: the view.
        marked: the goals.
        size: sizes of the particles (N,) [m], for the margin.
    """
    ends = [plane]
    for goal in marked:
        middle, half = look.axes @ goal.position, np.abs(look.axes) @ goal.spread
        ends.append(np.array([middle - half, middle + half]))
        if len(goal.course):
            ends.append(goal.course @ look.axes.T)
    extent = np.concatenate(ends)
    room = room_around(extent, size)
    return np.array([extent.min(axis=0) - room, extent.max(axis=0) + room])


def inside_boundaries(scene: Scene, points: Array, towards: Array | None = None) -> Array:
    """Return whether each of the points (n, D) is inside a boundary: (n,) of bool.

    A clamp that moves is left out: it is where its particles are, and its region says only where it began.

    Args:
        scene: the scene.
        points: the points (n, D) [m].
        towards: unit vector to the eye (D,), to omit faces of the world that would hide its inside.
    """
    inside = np.zeros(len(points), dtype=bool)
    world = np.array(scene.world.size)
    for name in scene.boundaries:
        condition: Any = boundary(scene, name)
        if getattr(condition, "moves", False):
            continue
        for where, normal in condition.places(points, world):
            hides = towards is not None and condition.region is None and np.array(normal) @ towards < -1e-9
            if not hides:
                inside |= where
    return inside


def boundary_section(scene: Scene, look: View, corners: Array, middle: Array) -> tuple[Array, Array, Array]:
    """Return the section of the boundaries with the plane of a view through `middle` (D,) [m].

    Returns:
        Coordinates to the right (a,) and upwards (b,) [m], and whether each point is inside a boundary: (b, a) of bool.
    """
    size = corners[1] - corners[0]
    counts = np.maximum(2, np.ceil(PIXELS * size / size.max()).astype(int))
    right, up = (np.linspace(corners[0, k], corners[1, k], counts[k]) for k in range(2))
    plane = np.stack([part.ravel() for part in np.meshgrid(right, up)], axis=1)
    points = plane @ look.axes + (middle @ look.towards) * look.towards
    return right, up, inside_boundaries(scene, points).reshape(counts[1], counts[0])


def plot_boundaries(axes: Axes, section: tuple[Array, Array, Array], factor: float) -> None:
    """Draw the section of the boundaries (`boundary_section`) as ground."""
    right, up, inside = section
    if inside.any() and not inside.all():
        scaled = factor * right, factor * up, inside.astype(float)
        axes.contourf(*scaled, levels=[0.5, 1.5], colors=[GROUND], zorder=0.5)
        axes.contour(*scaled, levels=[0.5], colors=[GREY], linewidths=0.6, zorder=0.6)


def plot_goals(axes: Axes, marked: Sequence[Goal], look: View, factor: float) -> None:
    """Mark goals, their ranges and their courses in axes that already have their limits."""
    from matplotlib.patches import Rectangle

    left, right = axes.get_xlim()
    for goal in marked:
        place = factor * look.axes @ goal.position
        side = 1 if place[0] < left + LABELS_RIGHT * (right - left) else -1
        axes.plot(
            *place, marker="P", markersize=8, color=TRUTH, markeredgecolor="white", linestyle="none", zorder=5
        )  # fmt: skip
        axes.annotate(
            goal.name, place, xytext=(6 * side, 6), textcoords="offset points", fontsize=7.5, color=INK, zorder=5,
            ha="left" if side > 0 else "right",
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.75, "linewidth": 0},
        )  # fmt: skip
        if len(goal.course):
            course = factor * look.axes @ goal.course.T
            axes.plot(*course, marker=".", markersize=3, color=TRUTH, linestyle="none", zorder=4)
        if goal.spread.any():
            half = factor * np.abs(look.axes) @ goal.spread
            box = Rectangle(place - half, *(2 * half), fill=False, edgecolor=TRUTH, linestyle="--", linewidth=0.9)
            box.set_zorder(4)
            axes.add_patch(box)


def frame_axes(axes: Axes, look: View, corners: Array, unit: Unit) -> None:
    """Give axes the limits of a window (2, 2) [m], equal scales, and ticks in a unit if the view has named axes."""
    from matplotlib.ticker import FuncFormatter

    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set_xlim(*(unit.factor * corners[:, 0]))
    axes.set_ylim(*(unit.factor * corners[:, 1]))
    if not look.names:
        axes.set_axis_off()
        return
    wide, tall = corners[1] - corners[0]
    axes.locator_params(axis="x", nbins=int(np.clip(5 * wide / tall, 2, 5)))
    axes.locator_params(axis="y", nbins=int(np.clip(5 * tall / wide, 3, 5)))
    axes.set_xlabel(unit.label(look.names[0]))
    axes.set_ylabel(unit.label(look.names[1]))
    for axis, direction in zip((axes.xaxis, axes.yaxis), look.axes, strict=True):
        if direction.sum() < 0:  # the axis of the world points left or down
            axis.set_major_formatter(FuncFormatter(lambda tick, _: f"{0.0 - tick:g}"))

"""bodies.png: the bodies at the first, the middle and the last frame, coloured by displacement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.contract import Array
from cqrun.errors import UsageError
from cqrun.figures.quantities import Unit, length_unit
from cqrun.figures.run_data import TRAJECTORY, RunData
from cqrun.figures.style import DISPLACEMENT_MAP, GREY, INK, TRUTH, new_figure
from cqrun.scene.schema import Scene
from cqrun.store.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection
    from matplotlib.figure import Figure

MOST_DOTS = 40_000
"""More particles than this are drawn thinned out, each dot larger."""

COVER = 1.3
"""Dots of particles that lie at random are larger by this than their mean distance, to leave few gaps."""

PIXELS = 240
"""Samples along the longer side of the view that show where boundaries hold the grid."""

MARGIN = 0.05
"""Free room around the bodies, in parts of their extent."""

TURN, TILT = 30.0, 20.0
"""The oblique view: turned about the vertical, and looked at from above [degrees]."""

PANEL = 3.0
"""Width of a panel [inch]."""


@dataclass(frozen=True)
class View:
    """An orthographic look at the world.

    Attributes:
        axes: unit vectors to the right and upwards in the picture (2, D).
        names: of these two axes; empty for an oblique view, which has no ticks.
    """

    axes: Array
    names: str = ""

    @property
    def towards(self) -> Array:
        """Unit vector to the eye (D,); zero in 2D."""
        return np.cross(*self.axes) if self.axes.shape[1] == 3 else np.zeros(2)


@dataclass(frozen=True)
class Snapshot:
    """The particles at one time.

    Attributes:
        time: [s].
        x: (N, D) [m].
        moved: length of the displacement since the first frame (N,) [m].
    """

    time: float
    x: Array
    moved: Array


# --- data ---------------------------------------------------------------------------------------------------


def snapshots(trajectory: Trajectory) -> list[Snapshot]:
    """Return the first, the middle and the last frame; fewer where there are fewer.

    Raises:
        UsageError: no frame was written.
    """
    frames = len(trajectory.time)
    if frames == 0:
        raise UsageError(f"{TRAJECTORY}: no frame in it yet, so there is nothing to draw")
    return [snapshot(trajectory, frame) for frame in sorted({0, frames // 2, frames - 1})]


def snapshot(trajectory: Trajectory, frame: int) -> Snapshot:
    """Return one frame."""
    x = trajectory.fields["x"]
    moved = np.sqrt(np.sum((x[frame] - x[0]) ** 2, axis=1))
    return Snapshot(float(trajectory.time[frame]), x[frame], moved)


def farthest_frame(trajectory: Trajectory) -> int:
    """Return the frame at which the particles are farthest from where they began, on the whole."""
    x = trajectory.fields["x"]
    return int(np.argmax([np.sum((frame - x[0]) ** 2) for frame in x]))


def views(scene: Scene, x: Array) -> list[View]:
    """Return how to look at positions x (..., D): the plane itself in 2D; from the side and from above in 3D.

    Up is against gravity, z without gravity; the side is the one that shows the bodies longest.
    """
    if scene.dim == 2:
        return [View(np.eye(2), "xy")]
    axes = np.eye(3)
    gravity = np.abs(scene.world.gravity)
    up = int(np.argmax(gravity)) if gravity.any() else 2
    extent = np.ptp(x.reshape(-1, 3), axis=0)
    across = max((axis for axis in range(3) if axis != up), key=lambda axis: extent[axis])
    side = View(axes[[across, up]], "xyz"[across] + "xyz"[up])
    back = -side.towards
    turn, tilt = np.radians(TURN), np.radians(TILT)
    right = np.cos(turn) * axes[across] + np.sin(turn) * back
    away = np.cos(turn) * back - np.sin(turn) * axes[across]
    return [side, View(np.stack([right, np.cos(tilt) * axes[up] + np.sin(tilt) * away]))]


def window(x: Array, view: View, room: float) -> Array:
    """Return what to show of positions x (..., D): lower and upper corner (2, 2) [m], with room around [m]."""
    plane = x.reshape(-1, x.shape[-1]) @ view.axes.T
    return np.array([plane.min(axis=0) - room, plane.max(axis=0) + room])


def of_equal_width(windows: Sequence[Array]) -> list[Array]:
    """Return windows of the width of the widest, their middles where they were: so all have one scale."""
    widest = max(float(w[1, 0] - w[0, 0]) for w in windows)
    out = []
    for corners in windows:
        more = 0.5 * (widest - float(corners[1, 0] - corners[0, 0]))
        out.append(corners + np.array([[-more, 0.0], [more, 0.0]]))
    return out


def room_around(scene: Scene, x: Array) -> float:
    """Return how much free room to leave around positions x (..., D) [m]."""
    return MARGIN * float(np.max(np.ptp(x.reshape(-1, x.shape[-1]), axis=0))) + dot_size(scene, x.shape[-2])


def dot_size(scene: Scene, count: int) -> float:
    """Return the diameter of a dot [m]: the distance between particles, of `count` in all."""
    spacings = [body.particle_spacing(scene.world.dx) for body in scene.bodies.values()]
    known = [spacing for spacing in spacings if spacing is not None]
    if known:
        return max(known)
    volume = sum(body.whole().volume() for body in scene.bodies.values())
    return COVER * float((volume / count) ** (1.0 / scene.dim))


def held(scene: Scene, view: View, corners: Array, middle: Array) -> tuple[Array, Array, Array]:
    """Return where boundaries hold the grid in the plane of a view through `middle` (D,) [m].

    Returns:
        Places to the right (a,) and upwards (b,) [m], and whether the grid is held there, (b, a) of bool.
    """
    size = corners[1] - corners[0]
    counts = np.maximum(2, np.ceil(PIXELS * size / size.max()).astype(int))
    right, up = (np.linspace(corners[0, k], corners[1, k], counts[k]) for k in range(2))
    plane = np.stack([part.ravel() for part in np.meshgrid(right, up)], axis=1)
    points = plane @ view.axes + (middle @ view.towards) * view.towards
    inside = np.zeros(len(points), dtype=bool)
    world = np.array(scene.world.size)
    for chosen in scene.boundaries.values():
        condition: Any = chosen.value
        for where, _ in condition.places(points, world):
            inside |= where
    return right, up, inside.reshape(counts[1], counts[0])


# --- drawing ------------------------------------------------------------------------------------------------


def draw_bodies(run: RunData) -> Figure:
    """Return the picture: a column a frame, a row a view."""
    trajectory = run.trajectory()
    shots = snapshots(trajectory)
    x = np.stack([shot.x for shot in shots])
    looks = views(run.scene, x)
    windows = of_equal_width([window(x, look, room_around(run.scene, x)) for look in looks])
    tall = [PANEL * float(np.clip((w[1, 1] - w[0, 1]) / (w[1, 0] - w[0, 0]), 0.25, 1.6)) for w in windows]
    figure = new_figure(PANEL * len(shots) + 1.3, sum(tall) + 0.35 * len(looks) + 0.75)
    panels = figure.subplots(len(looks), len(shots), squeeze=False, height_ratios=tall)
    largest = max(float(shot.moved.max()) for shot in shots)
    unit = length_unit(float(np.max(windows[0])))
    for row, (look, corners) in enumerate(zip(looks, windows, strict=True)):
        for axes, shot in zip(panels[row], shots, strict=True):
            dots = plot_body(axes, run.scene, shot, look, corners, unit, largest)
            axes.tick_params(labelleft=axes is panels[row, 0])
            if axes is not panels[row, 0]:
                axes.set_ylabel("")
            if row == 0:
                axes.set_title(f"t = {shot.time:.4g} s")
    colours = figure.colorbar(dots, ax=panels, shrink=0.85, pad=0.015, aspect=28)
    colours.set_label(f"displacement ({unit.name})")
    colours.outline.set_visible(False)
    name = run.name if trajectory.complete else f"{run.name}: as far as it is written"
    figure.suptitle(name, fontsize=9, color=GREY, x=0.995, ha="right")
    return figure


def plot_body(
    axes: Axes, scene: Scene, shot: Snapshot, view: View, corners: Array, unit: Unit, largest: float
) -> EllipseCollection:
    """Draw particles as dots of their spacing, the far ones first, and what holds them.

    Args:
        corners: what to show (2, 2) [m].
        largest: displacement at the end of the colours [m].
    """
    from matplotlib.collections import EllipseCollection

    stride = -(-len(shot.x) // MOST_DOTS)
    order = np.argsort(shot.x @ view.towards, kind="stable")[::stride]
    size = unit.factor * dot_size(scene, len(shot.x)) * stride ** (1.0 / scene.dim)
    if view.names:
        _plot_held(axes, held(scene, view, corners, shot.x.mean(axis=0)), unit.factor)
    dots = EllipseCollection(
        size, size, 0.0, units="xy", offsets=unit.factor * shot.x[order] @ view.axes.T,
        offset_transform=axes.transData, cmap=DISPLACEMENT_MAP, rasterized=True, edgecolors="white",
        linewidths=0.15 if scene.dim == 3 else 0.0,
    )  # fmt: skip
    dots.set_array(unit.factor * shot.moved[order])
    dots.set_clim(0.0, unit.factor * largest or 1.0)
    axes.add_collection(dots)
    _plot_target(axes, scene, view, unit.factor)
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set_xlim(*(unit.factor * corners[:, 0]))
    axes.set_ylim(*(unit.factor * corners[:, 1]))
    if view.names:
        wide, tall = corners[1] - corners[0]
        axes.locator_params(axis="x", nbins=int(np.clip(5 * wide / tall, 2, 5)))
        axes.locator_params(axis="y", nbins=int(np.clip(5 * tall / wide, 3, 5)))
        axes.set_xlabel(unit.label(view.names[0]))
        axes.set_ylabel(unit.label(view.names[1]))
    else:
        axes.set_axis_off()
    return dots


def _plot_held(axes: Axes, place: tuple[Array, Array, Array], factor: float) -> None:
    right, up, inside = place
    if inside.any() and not inside.all():
        scaled = factor * right, factor * up, inside.astype(float)
        axes.contourf(*scaled, levels=[0.5, 1.5], colors=["#DADADA"])
        axes.contour(*scaled, levels=[0.5], colors=[GREY], linewidths=0.6)


def _plot_target(axes: Axes, scene: Scene, view: View, factor: float) -> None:
    target = scene.data.target if scene.data is not None else None
    if target is None:
        return
    place = factor * view.axes @ np.array(target.position)
    axes.plot(*place, marker="P", markersize=8, color=TRUTH, markeredgecolor="white", linestyle="none")
    axes.annotate("target", place, xytext=(6, 6), textcoords="offset points", fontsize=7.5, color=INK)

"""bodies.png: the bodies at the first, the middle and the last frame, coloured by displacement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.figures.dots import COVER, COVER_3D, Dots, add_dots, far_to_near
from cqrun.figures.quantities import length_unit
from cqrun.figures.run_data import TRAJECTORY, RunData
from cqrun.figures.scenery import frame_axes, goals, held, plot_goals, plot_held, seen
from cqrun.figures.style import AMOUNT_MAP, GREY, PALE, new_figure
from cqrun.figures.views import View, of_equal_width, views
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene
from cqrun.store.frames import Frames
from cqrun.units import Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection
    from matplotlib.figure import Figure

MOST_DOTS = 150_000
"""More dots than this are drawn thinned out, each larger."""

PANEL = 3.0
"""Width of a panel [inch]."""


@dataclass(frozen=True)
class Snapshot:
    """The particles at one time.

    Attributes:
        time: [s].
        x: (N, D) [m].
        moved: length of the displacement since the first frame (N,) [m].
        dots: that fill the bodies.
        told: what the trajectory says of itself, where this run's goals and courses are.
    """

    time: float
    x: Array
    moved: Array
    dots: Dots
    told: dict[str, Any] = field(default_factory=dict)


# --- data ---------------------------------------------------------------------------------------------------


def snapshots(frames: Frames, shown: Sequence[int] | None = None) -> list[Snapshot]:
    """Return some frames; the first, the middle and the last one if not said, fewer where there are fewer.

    Raises:
        UsageError: no frame was written.
    """
    count = len(frames)
    if count == 0:
        raise UsageError(f"{TRAJECTORY}: no frame in it yet, so there is nothing to draw")
    rest = frames.read("x", 0)
    dots = Dots.of(rest, frames.bodies).thinned(rest, frames.bodies, MOST_DOTS)
    return [
        Snapshot(float(frames.time[k]), x, np.sqrt(np.sum((x - rest) ** 2, axis=1)), dots, frames.provenance)
        for k in (sorted({0, count // 2, count - 1}) if shown is None else shown)
        for x in [frames.read("x", k)]
    ]


def farthest_frame(frames: Frames) -> int:
    """Return the frame at which the particles are farthest from where they began, on the whole.

    It reads one frame at a time: a trajectory may be larger than the memory.
    """
    rest = frames.read("x", 0)
    return int(np.argmax([np.sum((frames.read("x", frame) - rest) ** 2) for frame in range(len(frames))]))


# --- drawing ------------------------------------------------------------------------------------------------


def draw_bodies(run: RunData) -> Figure:
    """Return the picture: a column a frame, a row a view."""
    with run.frames() as frames:
        shots, complete = snapshots(frames), frames.complete
    x = np.stack([shot.x for shot in shots])
    looks = views(run.scene, x)
    windows = of_equal_width([window_of(run.scene, shots, look) for look in looks])
    tall = [PANEL * float(np.clip((w[1, 1] - w[0, 1]) / (w[1, 0] - w[0, 0]), 0.25, 2.2)) for w in windows]
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
    name = run.name if complete else f"{run.name}: as far as it is written"
    figure.suptitle(name, fontsize=9, color=GREY, x=0.995, ha="right")
    return figure


def window_of(scene: Scene, shots: Sequence[Snapshot], look: View) -> Array:
    """Return the window that holds the particles of some snapshots, and what they are to reach (2, 2) [m]."""
    plane = np.concatenate([shot.x for shot in shots]) @ look.axes.T
    return seen(plane, look, goals(scene, shots[0].told), shots[0].dots.size)


def plot_body(
    axes: Axes,
    scene: Scene,
    shot: Snapshot,
    look: View,
    corners: Array,
    unit: Unit,
    largest: float,
    shown: tuple[Array, float, float] | None = None,
) -> EllipseCollection:
    """Draw particles as dots that cover the body, the far ones first, and what holds them.

    Args:
        corners: what to show (2, 2) [m].
        largest: displacement at the end of the colours [m].
        shown: what colours particles (N,) instead of their displacement, pale where it is no number, and both ends.
    """
    from matplotlib import colormaps

    x = shot.dots.positions(shot.x)
    order = far_to_near(x, look)
    if look.names:
        plot_held(axes, held(scene, look, corners, shot.x.mean(axis=0)), unit.factor)
    size = unit.factor * shot.dots.size[order]
    dots = add_dots(axes, size, edge=0.15 if scene.dim == 3 else 0.0, cover=COVER_3D if scene.dim == 3 else COVER)
    dots.set_offsets(unit.factor * x[order] @ look.axes.T)
    dots.set_cmap(colormaps[AMOUNT_MAP].with_extremes(bad=PALE))
    values, low, high = shown or (unit.factor * shot.moved, 0.0, unit.factor * largest or 1.0)
    dots.set_array(values[shot.dots.source[order]])
    dots.set_clim(low, high)
    frame_axes(axes, look, corners, unit)
    plot_goals(axes, goals(scene, shot.told), look, unit.factor)
    return dots

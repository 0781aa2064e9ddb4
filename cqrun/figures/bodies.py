"""bodies.png: the bodies at the first, the middle and the last frame, in the colours of the film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.figures.colours import colours
from cqrun.figures.dots import COVER_3D, Dots, OutlinedDots, add_dots, far_to_near
from cqrun.figures.fibres import fibres_of, plot_fibres
from cqrun.figures.quantities import length_unit
from cqrun.figures.rigid import extent_of, outlines, plot_rigid
from cqrun.figures.run_data import TRAJECTORY, RunData
from cqrun.figures.scenery import boundary_section, frame_axes, goals, plot_boundaries, plot_goals, window_with_goals
from cqrun.figures.style import GREY, new_figure
from cqrun.figures.views import View, of_equal_width, views
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene
from cqrun.store.frames import Frames
from cqrun.store.rigid_motion import RigidMotions
from cqrun.units import Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection
    from matplotlib.figure import Figure

MOST_DOTS = 150_000
"""If there are more dots than this, fewer and larger ones are drawn."""

PANEL = 3.0
"""Width of a panel [inch]."""


@dataclass(frozen=True)
class Snapshot:
    """The particles at one time.

    Attributes:
        frame: number of the frame.
        time: time of the frame [s].
        x: positions (N, D) [m].
        dots: the dots that fill the bodies.
        provenance: attributes of the trajectory, with the goals and courses of this run.
        step: its control step.
        rigid: how rigid bodies move in the run.
    """

    frame: int
    time: float
    x: Array
    dots: Dots
    provenance: dict[str, Any] = field(default_factory=dict)
    step: int = 0
    rigid: RigidMotions | None = None


# --- data ---------------------------------------------------------------------------------------------------


def snapshots(frames: Frames, shown: Sequence[int] | None = None) -> list[Snapshot]:
    """Return the frames `shown`, by default the first, the middle and the last one (fewer if there are fewer).

    Raises:
        UsageError: no frame was written.
    """
    count = len(frames)
    if count == 0:
        raise UsageError(f"{TRAJECTORY}: no frame in it yet, so there is nothing to draw")
    rest = frames.read("x", 0)
    dots, rigid = Dots.of(rest, frames.bodies).thinned(rest, frames.bodies, MOST_DOTS), frames.read_rigid()
    return [
        Snapshot(k, float(frames.time[k]), frames.read("x", k), dots, frames.provenance, int(frames.step[k]), rigid)
        for k in (sorted({0, count // 2, count - 1}) if shown is None else shown)
    ]


def farthest_frame(frames: Frames) -> int:
    """Return the frame with the largest mean squared displacement of the particles.

    Reads one frame at a time, because a trajectory may be larger than the memory.
    """
    rest = frames.read("x", 0)
    return int(np.argmax([np.sum((frames.read("x", frame) - rest) ** 2) for frame in range(len(frames))]))


# --- drawing ------------------------------------------------------------------------------------------------


def title_of(run: RunData, shot: Snapshot) -> str:
    """Return the time of a frame in words; equilibria have points of a path, or lines of a file, in place of times."""
    fits_lines = run.job == "sysid" and run.has_tables() and run.tracks()[0].at_rest
    if run.job != "rest" and not fits_lines:
        return f"t = {shot.time:.4g} s"
    return "rest shape" if shot.time == 0 else f"{'line' if fits_lines else 'point'} {shot.time:.0f}"


def draw_bodies(run: RunData) -> Figure:
    """Return the picture: a column for each frame, a row for each view."""
    with run.frames() as frames:
        shots, complete = snapshots(frames), frames.complete
        scheme = colours(None, run, frames)[1]
        shades = [scheme.rgb(shot.frame) for shot in shots]
    x = np.stack([shot.x for shot in shots])
    looks = views(run.scene, x)
    windows = of_equal_width([window_of(run.scene, shots, look) for look in looks])
    tall = [PANEL * float(np.clip((w[1, 1] - w[0, 1]) / (w[1, 0] - w[0, 0]), 0.25, 2.2)) for w in windows]
    figure = new_figure(PANEL * len(shots) + 1.3, sum(tall) + 0.35 * len(looks) + 0.75)
    panels = figure.subplots(len(looks), len(shots), squeeze=False, height_ratios=tall)
    at_rest = shots[0].frame == 0 and run.scene.start != "equilibrium"  # fibres are drawn where they are at rest
    unit, fibres = length_unit(float(np.max(windows[0]))), fibres_of(run.scene) if at_rest else []
    for row, (look, corners) in enumerate(zip(looks, windows, strict=True)):
        for axes, shot, rgb in zip(panels[row], shots, shades, strict=True):
            plot_body(axes, run.scene, shot, look, corners, unit, rgb)
            if axes is panels[row, 0]:
                plot_fibres(axes, fibres, look, corners, unit.factor)
            axes.tick_params(labelleft=axes is panels[row, 0])
            if axes is not panels[row, 0]:
                axes.set_ylabel("")
            if row == 0:
                axes.set_title(title_of(run, shot))
    bar = figure.colorbar(scheme.scale(), ax=panels, shrink=0.85, pad=0.015, aspect=28, extend=scheme.extend)
    bar.set_label(scheme.label)
    bar.outline.set_visible(False)
    name = run.name if complete else f"{run.name}: not complete yet"
    figure.suptitle(name, fontsize=9, color=GREY, x=0.995, ha="right")
    return figure


def window_of(scene: Scene, shots: Sequence[Snapshot], look: View) -> Array:
    """Return the window that contains the particles of some snapshots, and their goals (2, 2) [m]."""
    plane = np.concatenate([shot.x for shot in shots]) @ look.axes.T
    plane = np.concatenate([plane, *(extent_of(scene, shot.rigid, [shot.step], look) for shot in shots)])
    return window_with_goals(plane, look, goals(scene, shots[0].provenance), shots[0].dots.size)


def plot_body(
    axes: Axes,
    scene: Scene,
    shot: Snapshot,
    look: View,
    corners: Array,
    unit: Unit,
    rgb: Array,
) -> EllipseCollection:
    """Draw particles as dots that cover the body, with the boundaries; return the dots.

    In 2D, bodies have a darker line around them. In 3D, far dots are drawn first.

    Args:
        axes: axes to draw in.
        scene: the scene.
        shot: the particles.
        look: the view.
        corners: window to show (2, 2) [m].
        unit: unit of lengths.
        rgb: colours of the particles (N, 3) in 0 to 1.
    """
    x, colours_of_dots = shot.dots.positions(shot.x), rgb[shot.dots.source]
    if look.names:
        plot_boundaries(axes, boundary_section(scene, look, corners, shot.x.mean(axis=0)), unit.factor)
    if scene.dim == 2:
        outlined = OutlinedDots(axes, shot.dots, unit.factor)
        outlined.paint([(x, colours_of_dots)])
        dots = outlined.collection
    else:
        order = far_to_near(x, look)
        dots = add_dots(axes, unit.factor * shot.dots.size[order], edge=0.15, cover=COVER_3D)
        dots.set_offsets(unit.factor * x[order] @ look.axes.T)
        dots.set_facecolor(colours_of_dots[order])
    if scene.rigid:
        plot_rigid(axes, outlines(scene, shot.rigid, shot.step, look), unit.factor)
    frame_axes(axes, look, corners, unit)
    plot_goals(axes, goals(scene, shot.provenance), look, unit.factor)
    return dots

"""overview.png: one wide picture of a run: loss, first unknown, a track and the body."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from cqrun.figures.bodies import farthest_frame, plot_body, snapshots, window_of
from cqrun.figures.colours import colours
from cqrun.figures.convergence import plot_loss, plot_unknown, plot_violation, unknown_curves
from cqrun.figures.losses import loss_curve
from cqrun.figures.quantities import length_unit
from cqrun.figures.rest import name_points
from cqrun.figures.run_data import RunData
from cqrun.figures.style import INK, new_figure, titled
from cqrun.figures.tracks import explain, main_coordinate, plot_coordinate, rmse
from cqrun.figures.views import views
from cqrun.optimizers.constrained import VIOLATION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL, HEIGHT = 2.7, 2.35
"""Size of a panel [inch]."""


def draw_overview(run: RunData) -> Figure:
    """Return the picture: one panel for each part that the run has."""
    parts: list[Callable[[Axes, RunData], None]] = [_loss] if run.history else []
    if VIOLATION in run.history:
        parts.append(_violation)
    if run.history and any(curve.values.shape[1] for curve in unknown_curves(run)):
        parts.append(_unknown)
    if run.has_tables():
        parts.append(_tracks)
    if run.has_trajectory():
        parts.append(_body)
    figure = new_figure(PANEL * len(parts), HEIGHT)
    # each panel is a subfigure, so that the colour bar of the body moves no other axes
    for part, room in zip(parts, figure.subfigures(1, len(parts), squeeze=False)[0], strict=True):
        part(room.add_subplot(), run)
    return figure


def _loss(axes: Axes, run: RunData) -> None:
    plot_loss(axes, loss_curve(run))


def _violation(axes: Axes, run: RunData) -> None:
    plot_violation(axes, run)
    axes.set_xlabel("iteration")


def _unknown(axes: Axes, run: RunData) -> None:
    curve = next(curve for curve in unknown_curves(run) if curve.values.shape[1])
    plot_unknown(axes, run.history["iteration"], curve, show_bounds=False)
    axes.set_xlabel("iteration")


def _tracks(axes: Axes, run: RunData) -> None:
    tracks = run.tracks()[0]
    axis = main_coordinate(tracks)
    farthest = int(np.argmax(np.ptp(tracks.model[:, :, axis], axis=0)))
    plot_coordinate(axes, tracks, axis, [farthest], dots=INK)
    explain(axes)
    title = axes.get_ylabel()
    axes.set_ylabel("")
    axes.set_xlabel(tracks.axis if tracks.at_rest else "time (s)")
    name_points(axes, tracks)
    titled(axes, title, f"{tracks.channels[farthest]}; RMSE of {tracks.recording} {rmse(tracks)}")


def _body(axes: Axes, run: RunData) -> None:
    with run.frames() as frames:
        shots = snapshots(frames, [0, farthest_frame(frames)])
        scheme = colours(None, run, frames)[1]
        rgb = scheme.rgb(shots[-1].frame)
    shot = shots[-1]
    look = views(run.scene, np.stack([each.x for each in shots]))[-1]
    corners = window_of(run.scene, shots, look)
    unit = length_unit(float(np.max(np.abs(corners))))
    plot_body(axes, run.scene, shot, look, corners, unit, rgb)
    wide, tall = corners[1] - corners[0]
    place = "bottom" if wide > 1.6 * tall else "right"
    bar = axes.figure.colorbar(
        scheme.scale(), ax=axes, location=place, shrink=0.85, aspect=20, pad=0.04, extend=scheme.extend
    )
    bar.outline.set_visible(False)
    bar.set_label(scheme.label)
    axes.set_title(f"t = {shot.time:.3g} s")

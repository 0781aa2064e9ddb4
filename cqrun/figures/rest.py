"""tracks_<recording>.png of a recording at rest: poses in a plane, or a curve against a load, with their errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cqrun.figures.quantities import length_unit
from cqrun.figures.run_data import Tracks
from cqrun.figures.style import COLOURS, GREY, INK, new_figure, titled
from cqrun.figures.tracks import explain, main_axes, plot_coordinate, with_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_LABELS = 12
"""More poses are numbered, not named, along an axis."""


def draw_rest(tracks: Tracks, scene: str) -> Figure:
    """Return the picture of one recording at rest: markers in a plane, or a single channel against its load."""
    figure = _draw_poses(tracks) if tracks.data.shape[2] > 1 else _draw_curve(tracks)
    return with_title(figure, tracks, scene)


def _draw_poses(tracks: Tracks) -> Figure:
    """Draw the markers of every pose in a plane, measured and modelled, and their distances by pose."""
    figure = new_figure(9.6, 4.6)
    plane, errors = figure.subplots(1, 2, width_ratios=[1.2, 1.0])
    first, second = main_axes(tracks)
    unit = length_unit(float(np.abs(tracks.model).max()))
    for p in range(len(tracks.time)):
        colour = COLOURS[p % len(COLOURS)]
        data, model = (unit.factor * source[p][:, (first, second)] for source in (tracks.data, tracks.model))
        plane.plot(*model.T, color=colour, linewidth=1.0, marker=".", markersize=5)
        plane.plot(*data.T, linestyle="none", marker="o", markersize=5, markerfacecolor="none", color=colour)
        for ends in np.stack([data, model], axis=1):
            plane.plot(*ends.T, color=GREY, linewidth=0.6)
    plane.set_aspect("equal", adjustable="datalim")
    plane.set_xlabel(unit.label("xyz"[first]))
    plane.set_ylabel(unit.label("xyz"[second]))
    titled(plane, f"{tracks.measurement.channel.capitalize()}s of {len(tracks.time)} {tracks.axis}s")
    _explain_poses(plane)
    _plot_errors(errors, tracks)
    return figure


def _explain_poses(panel: Axes) -> None:
    from matplotlib.lines import Line2D

    circle = Line2D([], [], linestyle="none", marker="o", markerfacecolor="none", markersize=5, color=GREY)
    line = Line2D([], [], color=GREY, linewidth=1.0, marker=".", markersize=5)
    panel.legend([circle, line], ["data", "model"], loc="best")


def _plot_errors(panel: Axes, tracks: Tracks) -> None:
    """Draw the distance of every channel from the model by pose, and their mean."""
    factor = tracks.measurement.shown.factor
    error = factor * tracks.error
    for m, name in enumerate(tracks.channels):
        panel.plot(tracks.time, error[:, m], color=COLOURS[m % len(COLOURS)], linewidth=0.8, marker=".", label=name)
    seen = np.isfinite(error).any(axis=1)
    panel.plot(tracks.time[seen], np.nanmean(error[seen], axis=1), color=INK, linewidth=1.6, label="mean")
    panel.set_ylabel(tracks.measurement.shown.label("error"))
    panel.set_ylim(bottom=0.0)
    panel.set_xlabel(tracks.axis)
    name_points(panel, tracks)
    panel.legend(loc="best")


def name_points(panel: Axes, tracks: Tracks) -> None:
    """Write the names of the points along the axis, if they have names and are few."""
    if tracks.labels and len(tracks.labels) <= MOST_LABELS:
        panel.set_xticks(tracks.time, tracks.labels, rotation=40, ha="right")


def _draw_curve(tracks: Tracks) -> Figure:
    """Draw the channels against the load, and their errors."""
    figure = new_figure(6.4, 4.8)
    curve, errors = figure.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.0])
    plot_coordinate(curve, tracks, 0, range(len(tracks.channels)))
    explain(curve)
    factor = tracks.measurement.shown.factor
    for m, column in enumerate(factor * (tracks.model - tracks.data)[:, :, 0].T):
        errors.plot(tracks.time, column, color=COLOURS[m % len(COLOURS)], linewidth=0.8, marker=".")
    errors.axhline(0.0, color=GREY, linewidth=0.6)
    errors.set_ylabel(tracks.measurement.shown.label("model - data"))
    errors.set_xlabel(tracks.axis)
    name_points(errors, tracks)
    return figure

"""tracks_<recording>.png: a recording, the same from the model, and their difference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cqrun.figures.quantities import error, length_unit, shown_unit
from cqrun.figures.run_data import Tracks
from cqrun.figures.style import COLOURS, GREY, INK, new_figure, titled
from cqrun.plugin.contract import Array
from cqrun.units import Unit

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEW_MARKERS = 8
"""Up to this many markers are drawn one by one; of more markers, some paths are drawn in a plane."""

MOVES = 0.15
"""A coordinate is not drawn if it moves less than this part of the one that moves most."""

SHOWN_PATHS = 12
"""Number of paths that are drawn of many markers."""

SHOWN_TIMES = 3
"""Number of these paths that are also drawn against time."""


# --- data ---------------------------------------------------------------------------------------------------


def displacements(tracks: Tracks) -> tuple[Array, Array]:
    """Return data and model (T, M, D).

    Positions in a motion are relative to the model's in the first frame; other values are unchanged.
    """
    origin = tracks.model[0] if tracks.measurement.unit == "m" and not tracks.at_rest else 0.0
    return tracks.data - origin, tracks.model - origin


def rmse(tracks: Tracks) -> str:
    """Return the root mean square error as text, in its display unit."""
    unit = tracks.measurement.shown
    return f"{error(unit.factor * tracks.rmse())} {unit.name}".rstrip()


def moving_axes(tracks: Tracks) -> list[int]:
    """Return the coordinates to draw, in order: those that move in the model or in the data."""
    spans = _spans(tracks)
    largest = spans.max()
    return [axis for axis, span in enumerate(spans) if span >= MOVES * largest]


def main_coordinate(tracks: Tracks) -> int:
    """Return the coordinate that moves most in the model, which has no noise."""
    return int(np.argmax(np.ptp(tracks.model, axis=0).max(axis=0)))


def main_axes(tracks: Tracks) -> tuple[int, int]:
    """Return the two coordinates with the largest extent, in order: the plane in which paths are drawn."""
    if tracks.model.shape[2] == 2:
        return 0, 1
    extent = np.ptp(tracks.model.reshape(-1, tracks.model.shape[2]), axis=0)
    first, second = sorted(np.argsort(extent)[-2:].tolist())
    return first, second


def _spans(tracks: Tracks) -> Array:
    """Return the largest range of a marker along each axis (D,) [m], without outliers in the data."""
    model = np.ptp(tracks.model, axis=0).max(axis=0)
    seen = [m for m in range(len(tracks.channels)) if np.isfinite(tracks.data[:, m]).any()]
    if not seen:
        return np.asarray(model)
    low, high = np.nanpercentile(tracks.data[:, seen], [5, 95], axis=0)
    return np.asarray(np.maximum(model, (high - low).max(axis=0)))


def spread(points: Array, count: int, first: int = 0) -> list[int]:
    """Return the indices of `count` of the points (N, D) that are far apart, starting with `first`."""
    chosen = [first]
    nearest = np.sum((points - points[first]) ** 2, axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
    return chosen


# --- drawing ------------------------------------------------------------------------------------------------


def draw_recording(tracks: Tracks, scene: str) -> Figure:
    """Return the picture of one recording of a motion."""
    paths = len(tracks.channels) > FEW_MARKERS and tracks.data.shape[2] > 1
    return with_title(_draw_paths(tracks) if paths else _draw_channels(tracks), tracks, scene)


def with_title(figure: Figure, tracks: Tracks, scene: str) -> Figure:
    """Return the picture of a recording with its title."""
    kind = "held out" if tracks.holdout else "fitted"
    title = f"{scene}, {tracks.recording} ({kind}): RMSE {rmse(tracks)}"
    figure.suptitle(title, fontsize=10, fontweight="bold", color=INK, x=0.01, ha="left")
    return figure


def _draw_channels(tracks: Tracks) -> Figure:
    """Draw each channel against time: a row for each component, and one for the error."""
    axes = moving_axes(tracks)
    figure = new_figure(8.6, 0.6 + 2.0 * len(axes) + 1.5)
    panels = figure.subplots(len(axes) + 1, 1, sharex=True, height_ratios=[2.0] * len(axes) + [1.4])
    for panel, axis in zip(panels, axes, strict=False):
        lines = plot_coordinate(panel, tracks, axis, range(len(tracks.channels)))
    explain(panels[0])
    _plot_errors(panels[-1], tracks)
    panels[-1].set_xlabel("time (s)")
    unit = tracks.measurement.shown
    named = zip(tracks.channels, tracks.rmse_by_channel(), strict=True)
    texts = [f"{name}  {error(unit.factor * own)}" for name, own in named]
    figure.legend(lines, texts, title=unit.label("RMSE"), loc="outside right upper", alignment="left")
    return figure


def plot_coordinate(
    panel: Axes, tracks: Tracks, axis: int, channels: Sequence[int], dots: str | None = None
) -> list[Artist]:
    """Draw one component of some channels against time, data as dots and the model as lines; return the lines.

    Args:
        panel: axes to draw in.
        tracks: the recording.
        axis: index of the component.
        channels: indices of the channels.
        dots: colour of the data; the colour of the channel's line if not given.
    """
    lines: list[Artist] = []
    data, model = displacements(tracks)
    unit = shown_unit(tracks.measurement.unit, float(np.ptp(tracks.model, axis=0).max()))
    for place, m in enumerate(channels):
        colour = COLOURS[place % len(COLOURS)]
        panel.plot(
            tracks.time, unit.factor * data[:, m, axis], linestyle="none", marker="o", markersize=2.6,
            color=dots or colour, alpha=0.45, markeredgewidth=0,
        )  # fmt: skip
        lines += panel.plot(tracks.time, unit.factor * model[:, m, axis], color=colour, linewidth=1.3)
    component, quantity = tracks.components[axis], tracks.measurement.quantity
    panel.set_ylabel(unit.label(quantity if component == quantity else f"{component} {quantity}"))
    panel.margins(x=0.01)
    return lines


def explain(panel: Axes) -> None:
    """Add a legend that explains dots and lines."""
    from matplotlib.lines import Line2D

    dots = Line2D([], [], linestyle="none", marker="o", markersize=3, color=GREY)
    line = Line2D([], [], color=GREY, linewidth=1.3)
    panel.legend([dots, line], ["data", "model"], loc="upper right", ncols=2, handlelength=1.4, columnspacing=1.2)
    if panel.get_aspect() == "auto":
        _raise_top(panel, 0.15)


def _raise_top(panel: Axes, part: float) -> None:
    """Extend the vertical axis to make space for a legend along the top."""
    low, high = panel.get_ylim()
    panel.set_ylim(low, high + part * (high - low))


def _plot_errors(panel: Axes, tracks: Tracks) -> None:
    """Draw the distance of every channel from the model against time, and their root mean square."""
    factor = tracks.measurement.shown.factor
    for m, column in enumerate(factor * tracks.error.T):
        panel.plot(tracks.time, column, color=COLOURS[m % len(COLOURS)], linewidth=0.8, alpha=0.4)
    time, mean = rms_over_markers(tracks)
    label = f"root mean square of the {tracks.measurement.channel}s"
    panel.plot(time, factor * mean, color=INK, linewidth=1.3, label=label)
    panel.legend(loc="upper right")
    _finish_errors(panel, tracks)


def rms_over_markers(tracks: Tracks) -> tuple[Array, Array]:
    """Return the times at which any channel was seen (K,) [s], and the root mean square errors then (K,)."""
    seen = np.isfinite(tracks.error).any(axis=1)
    return tracks.time[seen], np.sqrt(np.nanmean(tracks.error[seen] ** 2, axis=1))


def _finish_errors(panel: Axes, tracks: Tracks) -> None:
    panel.set_ylabel(tracks.measurement.shown.label("error"))
    panel.set_ylim(bottom=0.0)
    _raise_top(panel, 0.2)
    panel.margins(x=0.01)


def _draw_paths(tracks: Tracks) -> Figure:
    """Draw paths of some markers in a plane, a few of them against time, and the error of all markers."""
    first, second = main_axes(tracks)
    unit = length_unit(float(np.abs(tracks.model).max()))
    figure = new_figure(10.0, 5.2)
    places = [["paths", "time"], ["paths", "error"]]
    panels: dict[str, Axes] = figure.subplot_mosaic(places, width_ratios=[1.15, 1.0], height_ratios=[1.5, 1.0])
    farthest = int(np.argmax(np.ptp(tracks.model, axis=0).max(axis=1)))
    shown = spread(tracks.model[0], SHOWN_PATHS, farthest)
    _plot_paths(panels["paths"], tracks, shown, (first, second), unit)
    plot_coordinate(panels["time"], tracks, main_coordinate(tracks), shown[:SHOWN_TIMES])
    titled(panels["time"], f"{min(SHOWN_TIMES, len(shown))} of them against time")
    _plot_error_band(panels["error"], tracks)
    panels["error"].set_xlabel("time (s)")
    panels["time"].sharex(panels["error"])
    panels["time"].tick_params(labelbottom=False)
    return figure


def _plot_paths(panel: Axes, tracks: Tracks, shown: list[int], plane: tuple[int, int], unit: Unit) -> None:
    for place, m in enumerate(shown):
        colour = COLOURS[place % len(COLOURS)]
        data, model = (unit.factor * source[:, m][:, plane].T for source in (tracks.data, tracks.model))
        panel.plot(*data, linestyle="none", marker="o", markersize=2, markeredgewidth=0, color=colour, alpha=0.35)
        panel.plot(*model, color=colour, linewidth=1.3)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel(unit.label("xyz"[plane[0]]))
    panel.set_ylabel(unit.label("xyz"[plane[1]]))
    titled(panel, f"Paths of {len(shown)} of {len(tracks.channels)} {tracks.measurement.channel}s")
    explain(panel)


def _plot_error_band(panel: Axes, tracks: Tracks) -> None:
    """Draw the error of all channels against time: the root mean square, and the band with 90 % of them."""
    time, mean = rms_over_markers(tracks)
    seen = np.isfinite(tracks.error).any(axis=1)
    factor, label = tracks.measurement.shown.factor, f"5 to 95 % of the {tracks.measurement.channel}s"
    low, high = factor * np.nanpercentile(tracks.error[seen], [5, 95], axis=1)
    panel.fill_between(time, low, high, color=COLOURS[0], alpha=0.18, linewidth=0, label=label)
    panel.plot(time, factor * mean, color=COLOURS[0], label="root mean square")
    panel.legend(loc="upper right", ncols=2)
    _finish_errors(panel, tracks)

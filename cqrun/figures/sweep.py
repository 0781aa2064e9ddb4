"""sweep.png: what the runs of a sweep found, against the values of its axes.

One axis of numbers gives lines. A complete grid of two gives heat maps. Other sweeps give parallel coordinates: a
vertical scale for each axis and each number that was found, and a line through them for each run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.figures.style import AMOUNT_MAP, COLOURS, GREY, PALE, log_ticks, new_figure, save, styled
from cqrun.plugin.contract import Array
from cqrun.scene.document import read
from cqrun.scene.keypath import shortest
from cqrun.store.study import Sweep, SweptRun, read_sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_SHOWN = 4
"""Numbers in a picture, if none is asked for."""

BEHIND = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
"""The box behind a text that lies on lines."""

EVEN = 1.02
"""Values whose steps differ by less than this factor are evenly spaced."""


def draw_sweep(path: Path, show: Sequence[str] = (), kinds: tuple[str, ...] = ("png",)) -> list[Path]:
    """Draw the sweep in `path`, in the same folder; return the paths of the pictures.

    Args:
        show: names of the numbers that are shown; at most `MOST_SHOWN` of those that differ if there are none.

    Raises:
        UsageError: no run found a number of this name.
    """
    sweep = read_sweep(path)
    names = list(show) or sweep.varying()[:MOST_SHOWN]
    for name in names:
        if name not in sweep.found:
            raise UsageError(
                f"--show {name}: no run found it{suggest(name, sweep.found)}; there are {listed(sweep.found)}"
            )
    if not names:
        return []
    with styled():
        return save(_figure(sweep, names), path.with_suffix(""), kinds)


def _figure(sweep: Sweep, names: Sequence[str]) -> Figure:
    axes = [path for path in sweep.axes if path != "seed"] or list(sweep.axes)
    columns = {path: _numbers(sweep.runs, path) for path in axes}
    numeric = [path for path in axes if columns[path] is not None]
    sizes = [len({run.values[path] for run in sweep.runs}) for path in axes]
    if len(axes) == 1 and numeric:
        return _lines(sweep, names, axes[0])
    if len(axes) == 2 and min(sizes) > 1 and len({_at(run, axes) for run in sweep.runs}) == np.prod(sizes):
        return _maps(sweep, names, axes)
    return _parallel(sweep, names, axes)


def _at(run: SweptRun, axes: Sequence[str]) -> tuple[str, ...]:
    return tuple(run.values[path] for path in axes)


def _numbers(runs: Sequence[SweptRun], path: str) -> Array | None:
    """Return the values of an axis as numbers (R,); None if some are not."""
    values = [read(run.values[path]).data for run in runs]
    whole = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return np.array(values, float) if whole else None


def _logarithmic(values: Array) -> bool:
    """Return whether values are spread like powers: evenly by their logarithm, or over more than a decade."""
    x = np.unique(values)
    if len(x) < 3 or x[0] <= 0.0:
        return False
    steps, factors = np.diff(x), x[1:] / x[:-1]
    return bool(steps.max() > EVEN * steps.min() and (factors.max() < EVEN * factors.min() or x[-1] > 30.0 * x[0]))


def _label(sweep: Sweep, name: str) -> str:
    unit = sweep.found[name].unit
    return f"{name} [{unit}]" if unit else name


def _lines(sweep: Sweep, names: Sequence[str], path: str) -> Figure:
    """Draw each number against the axis; several runs at a value (seeds) are dots, and their mean is the line."""
    figure = new_figure(4.4 * min(2, len(names)), 2.6 * (-(-len(names) // 2)))
    x = _numbers(sweep.runs, path)
    assert x is not None
    for k, (name, axes) in enumerate(zip(names, _panels(figure, len(names)), strict=True)):
        y = np.array([run.found.get(name, np.nan) for run in sweep.runs])
        seen = np.isfinite(y)
        at = np.unique(x[seen])
        axes.plot(at, [y[seen & (x == value)].mean() for value in at], color=COLOURS[k % len(COLOURS)])
        axes.plot(x[seen], y[seen], "o", color=COLOURS[k % len(COLOURS)], markersize=3.5)
        if _logarithmic(x):
            axes.set_xscale("log")
            log_ticks(axes.xaxis, float(x.min()), float(x.max()))
        axes.set_xlabel(shortest([path])[0])
        axes.set_ylabel(_label(sweep, name))
    return figure


def _panels(figure: Figure, count: int) -> list[Axes]:
    """Return `count` panels in rows of two, and hide the rest."""
    rows = -(-count // 2)
    every = np.atleast_1d(figure.subplots(rows, min(2, count))).ravel().tolist()
    for axes in every[count:]:
        axes.set_visible(False)
    return every[:count]


def _maps(sweep: Sweep, names: Sequence[str], axes: Sequence[str]) -> Figure:
    """Draw each number as a table of colours, with the value in each cell; several runs in a cell give their mean."""
    across, up = ([*dict.fromkeys(run.values[path] for run in sweep.runs)] for path in axes)
    figure = new_figure(4.2 * min(2, len(names)), 3.2 * (-(-len(names) // 2)))
    short = shortest(axes)
    for name, panel in zip(names, _panels(figure, len(names)), strict=True):
        sums, counts = np.zeros((len(up), len(across))), np.zeros((len(up), len(across)))
        for run in sweep.runs:
            if name in run.found:
                cell = up.index(run.values[axes[1]]), across.index(run.values[axes[0]])
                sums[cell], counts[cell] = sums[cell] + run.found[name], counts[cell] + 1
        means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        panel.grid(False)
        panel.set_facecolor(PALE)
        image = panel.imshow(means, origin="lower", aspect="auto", cmap=AMOUNT_MAP)
        middle = 0.5 * (np.nanmin(means) + np.nanmax(means)) if counts.any() else 0.0
        for (j, i), mean in np.ndenumerate(means) if means.size <= 100 else ():
            text = f"{mean:.3g}" if np.isfinite(mean) else "failed"
            panel.text(i, j, text, ha="center", va="center", size=7, color="white" if mean < middle else "black")
        panel.set_xticks(range(len(across)), across)
        panel.set_yticks(range(len(up)), up)
        panel.set_xlabel(short[0])
        panel.set_ylabel(short[1])
        figure.colorbar(image, ax=panel, label=_label(sweep, name))
    return figure


def _parallel(sweep: Sweep, names: Sequence[str], axes: Sequence[str]) -> Figure:
    """Draw parallel coordinates, coloured by the first number."""
    from matplotlib import colormaps

    scales = [(short, *_scale(sweep.runs, path)) for short, path in zip(shortest(axes), axes, strict=True)]
    for name in names:
        y = np.array([run.found.get(name, np.nan) for run in sweep.runs])
        scales.append((_label(sweep, name), *_ends(y)))
    figure = new_figure(1.5 * len(scales) + 1.0, 3.4)
    panel = figure.subplots()
    heights = np.array([height for _, height, _ in scales])
    shade = heights[len(axes)]
    order = np.argsort(np.where(np.isfinite(shade), shade, -1.0))
    for k in order:
        colour = colormaps[AMOUNT_MAP](shade[k]) if np.isfinite(shade[k]) else GREY
        panel.plot(range(len(scales)), heights[:, k], color=colour, linewidth=1.0, alpha=0.85)
    for k, (_, _, marks) in enumerate(scales):
        panel.axvline(k, color=GREY, linewidth=0.8)
        for height, text in marks:
            panel.text(k + 0.03, height, text, size=7, va="center", bbox=BEHIND)
    panel.grid(False)
    panel.set_xticks(range(len(scales)), [title for title, _, _ in scales])
    panel.set_yticks([])
    panel.spines["left"].set_visible(False)
    panel.set_xlim(-0.15, len(scales) - 0.6)
    return figure


Marks = list[tuple[float, str]]


def _scale(runs: Sequence[SweptRun], path: str) -> tuple[Array, Marks]:
    """Return the heights of an axis's values from 0 to 1 (R,), and its marks: heights and texts."""
    x = _numbers(runs, path)
    if x is not None:
        return _ends(np.log(x), np.exp) if _logarithmic(x) else _ends(x)
    values = [*dict.fromkeys(run.values[path] for run in runs)]
    places = {value: k / max(1, len(values) - 1) for k, value in enumerate(values)}
    return np.array([places[run.values[path]] for run in runs]), [(height, text) for text, height in places.items()]


def _ends(y: Array, back: Callable[[float], float] = float) -> tuple[Array, Marks]:
    """Return heights between the smallest and the largest number, and marks at both ends: `back` of the number."""
    seen = y[np.isfinite(y)]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)
    marks = [(0.0, f"{back(low):.3g}"), (1.0, f"{back(high):.3g}")] if high > low else [(0.5, f"{back(low):.3g}")]
    return ((y - low) / (high - low) if high > low else np.full(len(y), 0.5)), marks

"""sweep.png: what the runs of a sweep found, against the values of its axes.

One axis of numbers gives lines. A complete grid of two gives heat maps. Other sweeps give parallel coordinates: a
vertical scale for each axis and each number that was found, and a line through them for each run.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cqrun.figures.quantities import shown_unit
from cqrun.figures.style import (
    AMOUNT_MAP,
    COLOURS,
    GREY,
    PALE,
    in_lines,
    log_ticks,
    new_figure,
    save,
    styled,
    tick_text,
)
from cqrun.jobs.studies.sweep import numbers_shown
from cqrun.plugin.contract import Array
from cqrun.scene.document import read
from cqrun.store.study import Sweep, SweptRun, read_sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_SHOWN = 4
"""Numbers in a picture, if none is asked for."""

BEHIND = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
"""The box behind a text that lies on lines."""

LETTERS, OF_SCALE = 30, 17
"""Letters in a line of an axis' label, and of the label of a vertical scale."""

OF_VALUE, LINES = 22, 3
"""Letters in a line of a value that is no number, and its lines, at most."""

EVEN = 1.02
"""Values whose steps differ by less than this factor are evenly spaced."""


@dataclass(frozen=True)
class Column:
    """An axis of a sweep, or a number that was found, in the unit in which it is shown.

    Attributes:
        title: its name with the unit.
        texts: its value in each run (R).
        numbers: the same as numbers (R,), NaN where a run found none; None if they are no numbers.
    """

    title: str
    texts: list[str]
    numbers: Array | None

    def label(self, letters: int = LETTERS) -> str:
        """Return the title in lines of at most `letters` letters."""
        return in_lines(self.title, letters)

    def places(self) -> dict[str, int]:
        """Return the different values in the order of the runs, each with its number in it."""
        return {text: k for k, text in enumerate(dict.fromkeys(self.texts))}


def draw_sweep(path: Path, show: Sequence[str] = (), kinds: tuple[str, ...] = ("png",)) -> list[Path]:
    """Draw the sweep in `path`, in the same folder; return the paths of the pictures.

    Args:
        show: names of the numbers that are shown; at most `MOST_SHOWN` of those that differ if there are none.

    Raises:
        UsageError: no run found a number of this name.
    """
    sweep = read_sweep(path)
    show = numbers_shown(sweep, show)
    names = list(show) or sweep.varying()[:MOST_SHOWN]
    if not names:
        return []
    with styled():
        return save(_figure(sweep, names), path.with_suffix(""), kinds)


def _figure(sweep: Sweep, names: Sequence[str]) -> Figure:
    paths = [path for path in sweep.axes if path != "seed"] or list(sweep.axes)
    axes, found = [_axis(sweep, path) for path in paths], [_found(sweep, name) for name in names]
    sizes = [len(column.places()) for column in axes]
    if len(axes) == 1 and axes[0].numbers is not None:
        return _lines(found, axes[0])
    points = {tuple(run.values[path] for path in paths) for run in sweep.runs}
    if len(axes) == 2 and min(sizes) > 1 and len(points) == np.prod(sizes):
        return _maps(found, *axes)
    return _parallel(found, axes)


def _axis(sweep: Sweep, path: str) -> Column:
    texts, x, name = [run.values[path] for run in sweep.runs], _numbers(sweep.runs, path), sweep.titles()[path]
    if x is None:
        short = [textwrap.fill(text, OF_VALUE, max_lines=LINES, placeholder=" ...") for text in texts]
        return Column(name, _different(short, [textwrap.fill(text, OF_VALUE) for text in texts]), None)
    unit = shown_unit(sweep.unit(path), float(np.abs(x).max()))
    x = unit.factor * x
    return Column(_with_unit(name, unit.name), _different([*map(tick_text, x)], [*map(repr, x.tolist())]), x)


def _different(short: list[str], texts: list[str]) -> list[str]:
    """Return short texts; the long ones if different values had one short text."""
    return short if len(set(short)) == len(set(texts)) else texts


def _found(sweep: Sweep, name: str) -> Column:
    y = np.array([run.found.get(name, np.nan) for run in sweep.runs])
    unit = shown_unit(sweep.unit(name), float(np.nanmax(np.abs(y), initial=0.0)))
    return Column(_with_unit(sweep.titles()[name], unit.name), [], unit.factor * y)


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


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


def _lines(found: Sequence[Column], axis: Column) -> Figure:
    """Draw each number against the axis; several runs at a value (seeds) are dots, and their mean is the line."""
    from matplotlib.ticker import FuncFormatter

    figure = new_figure(4.4 * min(2, len(found)), 2.6 * (-(-len(found) // 2)))
    x = axis.numbers
    assert x is not None
    for k, (number, axes) in enumerate(zip(found, _panels(figure, len(found)), strict=True)):
        y = number.numbers
        assert y is not None
        seen = np.isfinite(y)
        at = np.unique(x[seen])
        axes.plot(at, [y[seen & (x == value)].mean() for value in at], color=COLOURS[k % len(COLOURS)])
        axes.plot(x[seen], y[seen], "o", color=COLOURS[k % len(COLOURS)], markersize=3.5)
        if _logarithmic(x):
            axes.set_xscale("log")
            log_ticks(axes.xaxis, float(x.min()), float(x.max()))
        else:
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: tick_text(value)))
        axes.set_xlabel(axis.label())
        axes.set_ylabel(number.label())
    return figure


def _panels(figure: Figure, count: int) -> list[Axes]:
    """Return `count` panels in rows of two, and hide the rest."""
    rows = -(-count // 2)
    every = np.atleast_1d(figure.subplots(rows, min(2, count))).ravel().tolist()
    for axes in every[count:]:
        axes.set_visible(False)
    return every[:count]


def _maps(found: Sequence[Column], across: Column, up: Column) -> Figure:
    """Draw each number as a table of colours, with the value in each cell; several runs in a cell give their mean."""
    columns, rows = across.places(), up.places()
    figure = new_figure(4.2 * min(2, len(found)), 3.2 * (-(-len(found) // 2)))
    cells = np.array([(rows[b], columns[a]) for a, b in zip(across.texts, up.texts, strict=True)])
    for number, panel in zip(found, _panels(figure, len(found)), strict=True):
        y = number.numbers
        assert y is not None
        seen = np.isfinite(y)
        sums, counts = np.zeros((len(rows), len(columns))), np.zeros((len(rows), len(columns)))
        np.add.at(sums, tuple(cells[seen].T), y[seen])
        np.add.at(counts, tuple(cells[seen].T), 1)
        means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        panel.grid(False)
        panel.set_facecolor(PALE)
        image = panel.imshow(means, origin="lower", aspect="auto", cmap=AMOUNT_MAP)
        middle = 0.5 * (np.nanmin(means) + np.nanmax(means)) if counts.any() else 0.0
        for (j, i), mean in np.ndenumerate(means) if means.size <= 100 else ():
            text = f"{mean:.3g}" if np.isfinite(mean) else "failed"
            panel.text(i, j, text, ha="center", va="center", size=7, color="white" if mean < middle else "black")
        panel.set_xticks(range(len(columns)), [*columns])
        panel.set_yticks(range(len(rows)), [*rows])
        panel.set_xlabel(across.label())
        panel.set_ylabel(up.label())
        figure.colorbar(image, ax=panel, label=number.label())
    return figure


def _parallel(found: Sequence[Column], axes: Sequence[Column]) -> Figure:
    """Draw parallel coordinates, coloured by the first number."""
    from matplotlib import colormaps

    scales = [*((column.label(OF_SCALE), *_scale(column)) for column in axes)]
    for number in found:
        assert number.numbers is not None
        scales.append((number.label(OF_SCALE), *_ends(number.numbers)))
    figure = new_figure(1.5 * len(scales) + 1.0, 3.6)
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


def _scale(column: Column) -> tuple[Array, Marks]:
    """Return the heights of an axis's values from 0 to 1 (R,), and its marks: heights and texts."""
    x = column.numbers
    if x is not None:
        return _ends(np.log(x), np.exp) if _logarithmic(x) else _ends(x)
    places = {text: k / max(1, len(column.places()) - 1) for text, k in column.places().items()}
    return np.array([places[text] for text in column.texts]), [(height, text) for text, height in places.items()]


def _ends(y: Array, back: Callable[[float], float] = float) -> tuple[Array, Marks]:
    """Return heights between the smallest and the largest number, and marks at both ends: `back` of the number."""
    seen = y[np.isfinite(y)]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)
    marks = [(0.0, _short(back(low))), (1.0, _short(back(high)))] if high > low else [(0.5, _short(back(low)))]
    return ((y - low) / (high - low) if high > low else np.full(len(y), 0.5)), marks


def _short(value: float) -> str:
    return tick_text(float(f"{value:.3g}"))

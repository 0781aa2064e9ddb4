"""One plot per test: every measured column against the cells across the body, the frames beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from benchmarks.convergence.points import Test
from benchmarks.convergence.table import Table
from benchmarks.convergence.worlds import FRAMES
from cqrun.figures.style import COLOURS, GREY, INK, new_figure, note, save, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES = (("-", "o"), ("--", "^"), (":", "v"), ("-.", "s"), ((0, (5, 1, 1, 1, 1, 1)), "D"))
"""Style and marker of a line by its case and its factor on the substeps; its colour is that of its law and nu."""

LEAST_RANGE = 1e-3
"""A linear axis shows at least this much on both sides of what is exact."""

LINEAR = 1e-5
"""Size below which an axis over decades is linear, so that it can show zero."""

MOST_COLUMNS = 3
"""Largest number of axes side by side, where there is one frame alone."""

Row = Mapping[str, str]


class Panel(NamedTuple):
    """One axes: a measured column in a frame; `last` has no axes below it."""

    ax: Axes
    name: str
    frame: str
    title: str
    last: bool


def draw(test: Test, table: Table, folder: Path, dim: int) -> Path | None:
    """Draw the rows of a test in one dimension; return the file, or None if the test has no rows.

    Raises:
        UsageError: the folder cannot be written to.
    """
    rows = [row for row in table.rows.values() if row["test"] == test.name and int(row["dim"]) == dim]
    rows = [row for row in rows if not row["note"]]
    if not rows:
        return None
    frames = sorted({row["frame"] for row in rows}, key=[*FRAMES, *(row["frame"] for row in rows)].index)
    with styled():
        shown = [name for name in test.columns if name not in test.hidden]
        figure, panels = _panels(shown, frames)
        for panel in panels:
            _lines(panel, rows)
        for panel in panels:  # when all lines are there, because panels share axes
            _axis(panel, test, sorted({int(row["cells"]) for row in rows}))
        figure.suptitle(f"{test.summary} ({dim}D)", x=0.01, ha="left", fontsize=9.5, fontweight="bold", color=INK)
        lines = {str(line.get_label()): line for panel in panels for line in panel.ax.get_lines()}
        handles = {label: line for label, line in lines.items() if not label.startswith("_")}
        ncols = min(len(panels), MOST_COLUMNS)
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=ncols, fontsize=7)
        folder.mkdir(parents=True, exist_ok=True)
        return save(figure, folder / f"{test.name}_{dim}d")[0]


def _panels(shown: Sequence[str], frames: Sequence[str]) -> tuple[Figure, list[Panel]]:
    """Return a figure and its panels: a row for each measured column, or all in a row for one frame alone."""
    if len(frames) == 1:
        across = min(len(shown), MOST_COLUMNS)
        down = -(-len(shown) // across)
        figure = new_figure(3.6 * across, 2.5 * down + 0.8)
        axes = figure.subplots(down, across, squeeze=False).ravel()
        for ax in axes[len(shown) :]:
            ax.set_visible(False)
        return figure, [Panel(ax, name, frames[0], _words(name), True) for name, ax in zip(shown, axes, strict=False)]
    figure = new_figure(3.6 * len(frames), 1.85 * len(shown) + 0.9)
    axes = figure.subplots(len(shown), len(frames), squeeze=False, sharey="row")
    return figure, [
        Panel(axes[i, j], name, frame, f"{_words(name)}, {frame}", i == len(shown) - 1)
        for i, name in enumerate(shown) for j, frame in enumerate(frames)
    ]  # fmt: skip


def _words(name: str) -> str:
    return name.replace("_", " ")


def _lines(panel: Panel, rows: Sequence[Row]) -> None:
    """Draw one line per variant; the rows of all frames decide its colour and style."""
    materials = list(dict.fromkeys(_material(row) for row in rows))
    cases = list(dict.fromkeys(_case(row) for row in rows))
    lines: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for row in rows:
        if row["frame"] == panel.frame and row.get(panel.name):
            lines.setdefault((_material(row), _case(row)), []).append((int(row["cells"]), float(row[panel.name])))
    for (material, case), points in lines.items():
        style, marker = STYLES[cases.index(case) % len(STYLES)]
        cells, values = zip(*sorted(points), strict=True)
        panel.ax.plot(
            cells, values, linestyle=style, marker=marker, markersize=3.5,
            color=COLOURS[materials.index(material) % len(COLOURS)], label=", ".join(filter(None, (material, case))),
        )  # fmt: skip


def _material(row: Row) -> str:
    return f"{_words(row['law'])}, nu {row['poissons_ratio']}"


def _case(row: Row) -> str:
    substeps = f"substeps x {row['substeps']}" if row["substeps"] != "1" else ""
    return ", ".join(filter(None, (row["case"], substeps)))


def _axis(panel: Panel, test: Test, ticks: Sequence[int]) -> None:
    """Set scales, ticks and titles."""
    ax, name = panel.ax, panel.name
    if name in test.ideal:
        ax.axhline(test.ideal[name], color=GREY, linewidth=0.8, linestyle=":")
    if name in test.decades:
        ax.set_yscale("symlog", linthresh=LINEAR)
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    else:
        ax.ticklabel_format(axis="y", useOffset=False)
        if (exact := test.ideal.get(name)) is not None:
            low, high = ax.get_ylim()
            ax.set_ylim(min(low, exact - LEAST_RANGE), max(high, exact + LEAST_RANGE))
    ax.set_xscale("log", base=2)
    ax.set_xticks(ticks, [str(tick) for tick in ticks])
    if panel.last:
        ax.set_xlabel("cells across")
    ax.set_title(panel.title, pad=15)
    note(ax, test.columns[name])

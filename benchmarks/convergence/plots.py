"""One plot per test: every measured column against the cells across the body, one line per frame and variant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.convergence.points import Test
from benchmarks.convergence.table import Table
from cqrun.figures.style import COLOURS, GREY, INK, new_figure, note, save, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STYLES = {"updated": "-", "reference": "--"}
MARKERS = {"1": "o", "4": "^", "16": "v"}
"""Style of a line by its frame, marker by its factor on the substeps; its colour is that of its law, nu and case."""

BODY = ("law", "poissons_ratio", "case")

LINEAR = 1e-5
"""Size below which an axis over decades is linear, so that it can show zero."""

MOST_COLUMNS = 3
"""Largest number of axes side by side."""


def draw(test: Test, table: Table, folder: Path, dim: int) -> Path | None:
    """Draw the rows of a test in one dimension; return the file, or None if the test has no rows.

    Raises:
        UsageError: the folder cannot be written to.
    """
    rows = [row for row in table.rows.values() if row["test"] == test.name and int(row["dim"]) == dim]
    rows = [row for row in rows if not row["note"]]
    if not rows:
        return None
    shown = [name for name in test.columns if name not in test.hidden]
    across = min(len(shown), MOST_COLUMNS)
    down = -(-len(shown) // across)
    with styled():
        figure = new_figure(3.1 * across, 2.4 * down + 0.7)
        axes = figure.subplots(down, across, squeeze=False)
        for ax in axes.ravel()[len(shown) :]:
            ax.set_visible(False)
        for name, ax in zip(shown, axes.ravel(), strict=False):
            _column(ax, test, name, rows)
        figure.suptitle(f"{test.summary} ({dim}D)", x=0.01, ha="left", fontsize=9.5, fontweight="bold", color=INK)
        handles = {h.get_label(): h for ax in axes.ravel() for h in ax.get_lines() if h.get_label()[0] != "_"}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, fontsize=7)
        folder.mkdir(parents=True, exist_ok=True)
        return save(figure, folder / f"{test.name}_{dim}d")[0]


def _column(ax: Axes, test: Test, name: str, rows: Sequence[Mapping[str, str]]) -> None:
    """Draw one measured column."""
    lines: dict[tuple[str, ...], list[tuple[int, float]]] = {}
    for row in rows:
        if row.get(name):
            variant = tuple(row[key] for key in ("frame", *BODY, "substeps"))
            lines.setdefault(variant, []).append((int(row["cells"]), float(row[name])))
    bodies = list(dict.fromkeys(tuple(row[key] for key in BODY) for row in rows))
    for variant, points in lines.items():
        frame, law, nu, case, substeps = variant
        what = " ".join([frame, law.replace("_", " "), f"nu {nu}", case]).strip()
        cells, values = zip(*sorted(points), strict=True)
        ax.plot(
            cells, values, STYLES.get(frame, ":"), marker=MARKERS.get(substeps, "D"), markersize=4,
            color=COLOURS[bodies.index((law, nu, case)) % len(COLOURS)],
            label=what + (f", substeps x {substeps}" if substeps != "1" else ""),
        )  # fmt: skip
    if name in test.ideal:
        ax.axhline(test.ideal[name], color=GREY, linewidth=0.8, linestyle=":")
    if name in test.decades:
        ax.set_yscale("symlog", linthresh=LINEAR)
        ax.set_ylim(bottom=min(-LINEAR, *(value for points in lines.values() for _, value in points)))
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    else:
        ax.ticklabel_format(axis="y", useOffset=False)
    ax.set_xscale("log", base=2)
    ticks = sorted({int(row["cells"]) for row in rows})
    ax.set_xticks(ticks, [str(tick) for tick in ticks])
    ax.set_xlabel("cells across")
    ax.set_title(name.replace("_", " "), pad=15)
    note(ax, test.columns[name])

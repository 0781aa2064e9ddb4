"""compare.png of simulations and equilibria: what several runs measure, in one picture with a line for each run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.figures.compare import run_labels
from cqrun.figures.measured import measured_along
from cqrun.figures.path import TABLE as REST_TABLE
from cqrun.figures.path import along_path, read_table
from cqrun.figures.quantities import shown_unit
from cqrun.figures.reactions import TABLE as REACTIONS
from cqrun.figures.run_data import RunData
from cqrun.figures.style import COLOURS, in_lines, legend_label, new_figure
from cqrun.plugin.contract import Array
from cqrun.store.measured import Quantity
from cqrun.units import force_units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORWARD = ("simulate", "rest")
"""Jobs that only run forward: there is no loss to compare."""

OBSERVABLES = "observables.csv"

MOST, ACROSS = 12, 3
"""Largest number of panels, and of panels in a row."""

ROUNDING = 1e-9
"""A number that stays below this part of others like it is zero but for rounding, such as a force along one axis."""

LETTERS, OF_LEGEND = 28, 60
"""Letters in a line of a label, and of the labels in a legend of two columns."""

STYLES = ("-", "--", ":", "-.")
"""Lines of the first runs, and of as many more as there are colours."""

UNITS = {"x": "m", "y": "m", "z": "m", "dx": "m", "dy": "m", "dz": "m", "fastest": "m/s"}
"""Unit of a column by the last part of its name."""


@dataclass(frozen=True)
class Curve:
    """One number over a run.

    Attributes:
        axis: what it is drawn against, with the unit.
        along: values of that (T,).
        values: (T,), NaN where it has no value.
        unit: SI unit of the values; empty for a pure number.
    """

    axis: str
    along: Array
    values: Array
    unit: str


def curves_of(run: RunData) -> list[dict[str, Curve]]:
    """Return the numbers over a run by name: measured quantities, reactions, and the motion of bodies."""
    rest = dict(_columns(run, run.path / REST_TABLE))
    return [dict(_measured(run)), *(dict(_columns(run, run.path / table)) | rest for table in (REACTIONS, OBSERVABLES))]


def _measured(run: RunData) -> Iterator[tuple[str, Curve]]:
    if not run.scene.measure or not run.has_trajectory():
        return
    with run.frames() as frames:
        measured = frames.read_measured()
    if measured is None:
        return
    axis, along = measured_along(run, measured)
    for owner, quantity in measured.quantities.items():
        for name, values in _numbers(owner, quantity, len(along)):
            yield name, Curve(axis, along, values, "" if quantity.unit == "1" else quantity.unit)


def _numbers(name: str, quantity: Quantity, count: int) -> Iterator[tuple[str, Array]]:
    yield from zip(quantity.names(name), quantity.values[-count:].T, strict=True)


def _columns(run: RunData, path: Path) -> Iterator[tuple[str, Curve]]:
    """Yield the columns of a table of bodies and boundaries that are not zero throughout."""
    if not path.is_file():
        return
    columns = read_table(path)
    axis, along = ("time [s]", columns["time"]) if "time" in columns else along_path(run, columns)
    owners = {*run.scene.bodies, *run.scene.boundaries}
    for name, values in columns.items():
        if name.partition(".")[0] in owners and name not in run.scene.path and np.nan_to_num(values).any():
            yield name, Curve(axis, along, values, _unit(name, run.scene.dim))


def _unit(name: str, dim: int) -> str:
    last, (force, moment) = name.rpartition(".")[2], force_units(dim)
    if last.startswith("force_"):
        return force
    if last == "moment" or last.startswith("moment_"):
        return moment
    if last == "kinetic_energy":
        return "J" if dim == 3 else "J/m"
    return UNITS.get(last, "")


def draw_overlay(runs: Sequence[RunData], name: str | None = None) -> Figure:
    """Return the picture: a panel for each number that a run has, with a line for each run that has it.

    Args:
        runs: the runs; their times and their steps may differ.
        name: a quantity, or one of its numbers, to show alone; as many as fit if None.

    Raises:
        UsageError: a run has no curves, there is no such quantity, or runs are along different things.
    """
    kinds = [curves_of(run) for run in runs]
    names = list(dict.fromkeys(name for kind in zip(*kinds, strict=True) for curves in kind for name in curves))
    every = [{name: curve for curves in of[::-1] for name, curve in curves.items()} for of in kinds]
    for run, curves in zip(runs, every, strict=True):
        if not curves:
            raise UsageError(f"{run.path}: it has no curve over time or along a path that could be compared")
    _require_one_axis(runs, every)
    shown = names if name is None else _asked(name, names)
    rows, columns = -(-len(shown[:MOST]) // ACROSS), min(ACROSS, len(shown))
    figure = new_figure(3.4 * max(columns, 2), 2.4 * rows + 0.3 * -(-len(runs) // 2))
    for k, each in enumerate(shown[:MOST], start=1):
        _plot(figure.add_subplot(rows, columns, k), each, [curves.get(each) for curves in every], _size(each, every))
    _legend(figure, run_labels(runs))
    if len(shown) > MOST:
        figure.suptitle(f"{MOST} of {len(shown)} quantities; --show also draws {listed(shown[MOST:], 4)}", fontsize=8)
    return figure


def _asked(name: str, names: Sequence[str]) -> list[str]:
    found = [each for each in names if each == name or each.startswith(f"{name}.")]
    if not found:
        raise UsageError(f"--show {name}: no run has it{suggest(name, names)}; there are {listed(names)}")
    return found


def _require_one_axis(runs: Sequence[RunData], every: Sequence[dict[str, Curve]]) -> None:
    """Raise a UsageError if runs are drawn against different things."""
    axes = {curve.axis: run.path for run, curves in zip(runs, every, strict=True) for curve in curves.values()}
    if len(axes) > 1:
        examples = "; ".join(f"{path}: {axis}" for axis, path in axes.items())
        raise UsageError(f"these runs are along different things, which one axis cannot compare: {examples}")


def _size(name: str, every: Sequence[dict[str, Curve]]) -> float:
    """Return the largest value of the numbers that have the owner and the unit of a number, such as of all forces."""
    owner, unit = name.rpartition(".")[0], next(curves[name].unit for curves in every if name in curves)
    alike = [c for curves in every for n, c in curves.items() if n.rpartition(".")[0] == owner and c.unit == unit]
    return max(float(np.nanmax(np.abs(curve.values), initial=0.0)) for curve in alike)


def _style(place: int) -> dict[str, Any]:
    return {"color": COLOURS[place % len(COLOURS)], "linestyle": STYLES[place // len(COLOURS) % len(STYLES)]}


def _plot(axes: Axes, name: str, curves: Sequence[Curve | None], size: float) -> None:
    """Draw one number of all runs that have it; zeros with rounding errors on the scale of others, up to `size`."""
    there = [curve for curve in curves if curve is not None]
    largest = max(float(np.nanmax(np.abs(curve.values), initial=0.0)) for curve in there)
    unit = shown_unit(there[0].unit, largest)
    for place, curve in enumerate(curves):
        if curve is not None:
            marker = "" if curve.axis == "time [s]" else "."
            axes.plot(curve.along, unit.factor * curve.values, marker=marker, **_style(place))
    if largest < ROUNDING * size:
        axes.set_ylim(-unit.factor * size, unit.factor * size)
    axes.set_xlabel(in_lines(there[0].axis, LETTERS))
    axes.set_ylabel(in_lines(f"{name} [{unit.name}]" if unit.name else name, LETTERS))


def _legend(figure: Figure, labels: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], label=legend_label(label), **_style(place)) for place, label in enumerate(labels)]
    figure.legend(handles=lines, loc="outside lower left", ncols=1 if max(map(len, labels)) > OF_LEGEND else 2)

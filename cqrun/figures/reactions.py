"""reactions.png: the force and the moment with which boundaries act on the bodies, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cqrun.figures.path import MOST_LINES, read_table
from cqrun.figures.run_data import RunData
from cqrun.figures.style import COLOURS, new_figure, titled
from cqrun.plugin.contract import Array
from cqrun.units import force_units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TABLE = "reactions.csv"
STYLES = {"x": "-", "y": "--", "z": ":", "": "-"}
"""The line of each component."""


def has_reactions(run: RunData) -> bool:
    """Return whether a run has reactions to draw: some that are not zero throughout."""
    if not (run.path / TABLE).is_file():
        return False
    columns = read_table(run.path / TABLE)
    return any(np.any(values) for name, values in columns.items() if name != "time")


def draw_reactions(run: RunData) -> Figure:
    """Draw forces and moments of every boundary that acts; of many boundaries their sizes."""
    columns = read_table(run.path / TABLE)
    figure = new_figure(9.6, 3.4)
    force, moment = figure.subplots(1, 2, sharex=True)
    units, names = force_units(run.scene.dim), (*run.scene.boundaries, *run.scene.rigid)
    for axes, kind, unit in zip((force, moment), ("force", "moment"), units, strict=True):
        _plot(
            axes,
            columns["time"],
            {name: _parts(columns, name, kind) for name in names},
        )
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{kind} on the bodies [{unit}]")
    titled(force, f"{run.name}: reactions, means over control steps")
    return figure


def _parts(columns: dict[str, Array], name: str, kind: str) -> dict[str, Array]:
    """Return the components of a boundary's force or moment by axis; by "" where there is only one."""
    found = {axis: columns.get(f"{name}.{kind}_{axis}") for axis in "xyz"} | {"": columns.get(f"{name}.{kind}")}
    return {axis: values for axis, values in found.items() if values is not None}


def _plot(axes: Axes, time: Array, parts: dict[str, dict[str, Array]]) -> None:
    """Draw a line for each component, or for each boundary if there would be too many."""
    acting = {name: of for name, of in parts.items() if any(values.any() for values in of.values())}
    if sum(map(len, acting.values())) > MOST_LINES:
        acting = {name: {"": np.linalg.norm(list(of.values()), axis=0)} for name, of in acting.items()}
    for number, (name, of) in enumerate(list(acting.items())[:MOST_LINES]):
        for axis, values in of.items():
            label, colour = f"{name}, {axis}" if axis else name, COLOURS[number % len(COLOURS)]
            axes.plot(time, values, STYLES[axis], color=colour, linewidth=1.2, label=label)
    if acting:
        axes.legend(loc="best")

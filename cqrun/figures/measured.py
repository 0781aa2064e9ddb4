"""measured.png: the quantities that a scene measures, over time or along a path of equilibria."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cqrun.explain import listed
from cqrun.figures.path import TABLE as REST_TABLE
from cqrun.figures.path import along_path, read_table
from cqrun.figures.run_data import RunData
from cqrun.figures.style import COLOURS, new_figure
from cqrun.plugin.contract import Array
from cqrun.store.measured import TABLE, MeasuredQuantities, Quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST, ACROSS = 12, 3
"""Largest number of panels, and of panels in a row; the table has all quantities."""

LONG = 36
"""A label of more letters than this is divided into two lines."""


def has_measured(run: RunData) -> bool:
    """Return whether a run has measured quantities: two values of each or more."""
    return _measured(run) is not None


def _measured(run: RunData) -> MeasuredQuantities | None:
    """Return the measured quantities of a run; None if there are none to draw."""
    if not run.scene.measure or not (run.path / TABLE).is_file() or not run.has_trajectory():
        return None
    with run.frames() as frames:
        measured = frames.read_measured()
    return None if measured is None or len(measured.time) < 2 else measured


def draw_measured(run: RunData) -> Figure:
    """Draw a panel for each quantity of a run that has some, with a line for each of its components."""
    measured = _measured(run)
    assert measured is not None
    label, along = measured_along(run, measured)
    shown = list(measured.quantities.items())[:MOST]
    columns = min(ACROSS, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure(3.4 * columns, 2.5 * rows)
    for k, (name, quantity) in enumerate(shown, start=1):
        axes = figure.add_subplot(rows, columns, k)
        _plot(axes, name, quantity, along, marker="." if measured.at_rest else "")
        axes.set_xlabel(label)
    if len(measured.quantities) > MOST:
        rest = listed(list(measured.quantities)[MOST:], 4)
        figure.suptitle(f"{MOST} of {len(measured.quantities)} quantities; {TABLE} also has {rest}")
    return figure


def _plot(axes: Axes, name: str, quantity: Quantity, along: Array, marker: str) -> None:
    """Draw the lines of one quantity."""
    values = quantity.values[-len(along) :]
    for k, component in enumerate(quantity.components):
        axes.plot(along, values[:, k], marker=marker, color=COLOURS[k % len(COLOURS)], label=component)
    unit = "" if quantity.unit == "1" else f" [{quantity.unit}]"
    what = f"{quantity.meaning}{unit}"
    axes.set_ylabel(what if len(what) <= LONG else f"{quantity.meaning}\n{unit.strip()}")
    axes.set_title(name)
    if len(quantity.components) > 1:
        axes.legend()


def measured_along(run: RunData, measured: MeasuredQuantities) -> tuple[str, Array]:
    """Return what the quantities are drawn against, and its values (T,) or, without the rest shape, (T - 1,)."""
    if not measured.at_rest:
        return "time [s]", measured.time
    if not (run.path / REST_TABLE).is_file():
        return "point", measured.time
    label, along = along_path(run, read_table(run.path / REST_TABLE))
    return (label, along) if label != "point" and len(along) == len(measured.time) - 1 else ("point", measured.time)

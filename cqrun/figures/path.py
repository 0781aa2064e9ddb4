"""path.png: what bodies and boundaries do along a path of equilibria, against the first value that the path changes."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cqrun.disk import open_file
from cqrun.figures.run_data import RunData
from cqrun.figures.style import new_figure
from cqrun.plugin.contract import Array
from cqrun.scene.load_path import ACTIVATION
from cqrun.scene.paths import leaf
from cqrun.units import force_units

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TABLE = "rest.csv"
MOST_LINES = 8
"""Lines in a panel; a legend of more covers them."""


def read_table(path: Path) -> dict[str, Array]:
    """Return the columns of a table by name; empty cells are NaN."""
    with open_file(path, "r", newline="", encoding="utf-8") as file:
        head, *rows = list(csv.reader(file))
    values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    return dict(zip(head, values.T, strict=True))


def has_path(run: RunData) -> bool:
    """Return whether a run has a curve to draw: two points or more."""
    return bool(run.scene.path) and (run.path / TABLE).is_file() and len(read_table(run.path / TABLE)["point"]) > 1


def draw_path(run: RunData) -> Figure:
    """Draw displacements and reactions against the path."""
    columns, scene = read_table(run.path / TABLE), run.scene
    label_along, along = along_path(run, columns)
    force, _ = force_units(scene.dim)
    moved = {name: 1e3 * size for name, size in _displacements(run, columns).items()}
    forces = {
        name: _length(columns, f"{name}.force_")
        for name in (*scene.boundaries, *scene.rigid)
        if f"{name}.force_x" in columns
    }
    panels = [("displacement [mm]", moved), (f"reaction [{force}]", forces)]
    panels = [(label, lines) for label, lines in panels if lines]
    figure = new_figure(3.4 * len(panels), 2.8)
    for k, (label, lines) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, len(panels), k)
        for name, values in list(lines.items())[:MOST_LINES]:
            axes.plot(along, values, marker=".", label=name)
        axes.set_xlabel(label_along)
        axes.set_ylabel(label)
        axes.legend()
    return figure


def along_path(run: RunData, columns: dict[str, Array]) -> tuple[str, Array]:
    """Return what equilibria are drawn against: the first value that the path changes, with its unit, or their numbers.

    Args:
        run: the run.
        columns: its table of equilibria, by name (T,).
    """
    key = next(iter(run.scene.path), "")
    if key not in columns or not np.isfinite(columns[key]).all():
        return "point", columns["point"]
    unit = "1" if key.startswith(ACTIVATION) else leaf(run.scene, key).unit
    if unit == "N":
        unit = force_units(run.scene.dim)[0]
    return key if unit == "1" else f"{key} [{unit}]", columns[key]


def _displacements(run: RunData, columns: dict[str, Array]) -> dict[str, Array]:
    """Return the size of the displacement of every group, or of the bodies' centres from the first point, [m]."""
    axes = "xyz"[: run.scene.dim]
    groups = {
        f"{name}.{group}": _length(columns, f"{name}.{group}.d")
        for name, body in run.scene.bodies.items()
        for group in body.groups
    }
    if groups:
        return groups
    centres = {name: np.stack([columns[f"{name}.{axis}"] for axis in axes]) for name in run.scene.bodies}
    return {name: np.linalg.norm(x - x[:, :1], axis=0) for name, x in centres.items()}


def _length(columns: dict[str, Array], prefix: str) -> Array:
    """Return the length of the vectors whose components have this prefix."""
    parts = [columns[f"{prefix}{axis}"] for axis in "xyz" if f"{prefix}{axis}" in columns]
    return np.asarray(np.linalg.norm(parts, axis=0))

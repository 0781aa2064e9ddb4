"""Figures with frames of a motion side by side, and the path of a part of the body (CQ1 Figs 3, 4 and 6)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.families.histories import runs_below
from benchmarks.papers.families.integrity import watch
from benchmarks.papers.figure import Figure, Folders, Size, Table
from cqrun.build.particles import sample
from cqrun.figures.bodies import plot_body, snapshots, window_of
from cqrun.figures.colours import colours
from cqrun.figures.quantities import length_unit
from cqrun.figures.run_data import RunData, read_run
from cqrun.figures.style import COLOURS, new_figure
from cqrun.figures.views import views, window
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

WIDTH = 9.0
"""Of the picture [inch]."""

GROUND = 2.0
"""Cells below the lowest particle that are shown at least: a body rests about one cell above its floor."""


class Frames(Figure):
    """Frames of one run."""

    needs_runs = True
    name: ClassVar[str]  # of the task whose best run is shown
    term: ClassVar[str] = ""  # of its objective that says which run is best; if empty, the first run is shown
    greatest: ClassVar[bool] = True  # whether the best run has the greatest term, or the least
    body: ClassVar[str]
    group: ClassVar[str | None] = None  # of the body, whose path is in the table
    count: ClassVar[int] = 6  # of frames
    columns: ClassVar[int] = 3  # frames side by side
    unit: ClassVar[str] = "m"  # of the scene's lengths

    def best(self, folders: Folders) -> RunData | None:
        """Return the run that is shown, or None while no run has a trajectory."""
        paths = [path.parent for path in sorted(Path(folders[self.name]).rglob("trajectory.h5"))]
        runs = [run for run in runs_below(folders[self.name]) if run.has_trajectory]
        if not paths:
            return None
        if not self.term or not runs:
            return read_run(paths[0])
        sign = 1.0 if self.greatest else -1.0
        return read_run(max(runs, key=lambda run: sign * run.at_least_loss(self.term)).path)

    def table(self, folders: Folders, size: Size) -> Table:
        """Return time [s], the mean position of the group, and how well the body holds together, for each frame."""
        run = self.best(folders)
        if run is None:
            return {}
        trajectory, particles = run.trajectory(), sample(run.scene)
        part = particles.of(self.body)
        group = np.arange(part.start, part.stop) if self.group is None else particles.groups(self.body)[self.group]
        path = trajectory.fields["x"][:, group].mean(axis=1)
        table = {"time": np.asarray(trajectory.time), **{"xyz"[d]: path[:, d] for d in range(path.shape[1])}}
        return table | watch(run, self.body)

    def moments(self, table: Table) -> Array:
        """Return the indices of the frames that are drawn: evenly spread over the time."""
        return np.round(np.linspace(0, len(table["time"]) - 1, self.count)).astype(int)

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw the moments side by side."""
        run = self.best(folders)
        assert run is not None
        with run.frames() as frames:
            shots = snapshots(frames, self.moments(table).tolist())
            _, scheme = colours("displacement", run, frames)
            shades = [scheme.rgb(shot.frame) for shot in shots]
        x = np.stack([shot.x for shot in shots])
        look = views(run.scene, x)[0]
        corners = window_of(run.scene, shots, look)
        corners[0, 1] = min(corners[0, 1], window(x, look, GROUND * run.scene.world.dx)[0, 1])
        rows = -(-self.count // self.columns)
        width = WIDTH / self.columns
        height = width * float(np.clip((corners[1, 1] - corners[0, 1]) / (corners[1, 0] - corners[0, 0]), 0.2, 1.6))
        picture = new_figure(WIDTH + 0.9, rows * (height + 0.55))
        panels = picture.subplots(rows, self.columns, squeeze=False).ravel()
        unit = length_unit(float(np.max(corners)))
        for axes, shot, rgb in zip(panels, shots, shades, strict=False):
            plot_body(axes, run.scene, shot, look, corners, unit, rgb)
            path = np.stack([table[axis] for axis in "xyz" if axis in table], axis=1)
            upto = table["time"] <= shot.time + 1e-9
            (line,) = axes.plot(*(unit.factor * (path @ look.axes.T)[upto]).T, color=COLOURS[1], lw=1.0)
            axes.set_title(f"t = {shot.time:.3g} s")
            axes.locator_params(axis="x", nbins=4 if self.columns < 5 else 2, min_n_ticks=1)
            axes.set_xlabel(axes.get_xlabel().replace("(m)", f"[{self.unit}]"))
            axes.set_ylabel(axes.get_ylabel().replace("(m)", f"[{self.unit}]"))
        for axes in panels[self.count :]:
            axes.remove()
        picture.legend([line], [f"path of the middle of the {self.group or self.body}"], loc="outside lower center")
        shown = list(panels[: self.count])
        bar = picture.colorbar(scheme.scale(), ax=shown, shrink=0.85, pad=0.015, aspect=28, extend=scheme.extend)
        bar.set_label(scheme.label.replace("(m)", f"[{self.unit}]"))
        bar.outline.set_visible(False)
        return picture

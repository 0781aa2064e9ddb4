"""CQ2's video: numerical fracture against particles a cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.histories import observables
from benchmarks.papers.figure import Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.runs import Runs
from benchmarks.papers.machinery.task import Task
from cqrun.figures.style import COLOURS, new_figure, titled

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

COUNTS = (1, 4, 9, 16)
"""Particles a cell."""

GREATEST = 150.0
"""Acceleration of the bar's end at the end of the run [m/s^2]; it grows linearly from 0."""

DURATION = 4.0


class Fracture(Figure):
    """Pairs of neighbours that no longer share a node of the grid, against the pull."""

    id = "cq2_fracture"
    title = "More particles a cell delay numerical fracture"
    source = "CQ2, video"
    paper = "more particles a cell delay numerical fracture (shown, without numbers)"
    criteria = {
        size: "all four bars tear, and the pull at which they tear grows with the particles a cell" for size in Size
    }
    notes = "The bar, its material and the pull are ours"

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return a run for each number of particles, the same at both sizes."""
        return [
            Runs(f"tear_{n}", 0.1, "simulate", "simulate/tear", (f"bodies.bar.particles_per_cell={n}",)) for n in COUNTS
        ]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return particles_per_cell, pull [m/s^2], lost (pairs of neighbours, over their maximum)."""
        rows: list[dict[str, object]] = []
        for name, folder in folders.items():
            seen = observables(folder)
            lost = seen["bar.fracture"] / max(1.0, seen["bar.fracture"].max())
            pull = GREATEST * seen["time"] / DURATION
            n = int(name.rpartition("_")[2])
            rows += (
                {"particles_per_cell": n, "pull": float(a), "lost": float(b)} for a, b in zip(pull, lost, strict=True)
            )
        return table_of(iter(rows))

    def tears(self, table: Table) -> dict[int, float]:
        """Return the pull at which the first pair is lost, by particles a cell; infinite if none is lost."""
        first = {}
        for n in np.unique(table["particles_per_cell"]):
            torn = (table["particles_per_cell"] == n) & (table["lost"] > 0)
            first[int(n)] = float(table["pull"][torn].min()) if torn.any() else np.inf
        return first

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw the lost pairs, and the pull at which the bar tears."""
        picture = new_figure(7.6, 3.2)
        left, right = picture.subplots(1, 2)
        for colour, n in zip(COLOURS, np.unique(table["particles_per_cell"]), strict=False):
            rows = table["particles_per_cell"] == n
            left.plot(table["pull"][rows], 100 * table["lost"][rows], color=colour, label=f"{n:g} a cell")
        left.set_xlabel("pull on the bar's end [m/s$^2$]")
        left.set_ylabel("lost neighbours [% of the most]")
        picture.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=4)
        tears = self.tears(table)
        right.plot(list(tears), list(tears.values()), "o-", color=COLOURS[0])
        right.set_xlabel("particles a cell")
        right.set_ylabel("pull at which it tears [m/s$^2$]")
        right.set_ylim(bottom=0)
        titled(left, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the order."""
        tears = self.tears(table)
        text = ", ".join(f"{n}: {pull:.3g}" for n, pull in tears.items())
        ordered = list(tears) == list(COUNTS) and bool(np.all(np.diff(list(tears.values())) > 0))
        return Verdict.of(
            {
                f"particles a cell and pull at which they tear: {text} m/s^2": ordered
                and bool(np.isfinite(list(tears.values())).all())
            }
        )

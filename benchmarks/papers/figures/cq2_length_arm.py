"""CQ2 5.3.1: how long must an arm be to touch its goal?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.histories import first_below, runs_below
from benchmarks.papers.figure import Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.runs import Runs
from benchmarks.papers.machinery.task import Task
from cqrun.figures.style import COLOURS, GREY, new_figure, titled

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

SCENE = "codesign/arm_length"
LENGTH = "value:bodies.arm.shape.box.size.1"
START = 0.4
LABELS = {"free": "length free", "fixed": "length fixed"}
NEAR = 1e-3


class LengthArm(Figure):
    """Distance of the tip to its goal against the step, with a free and a fixed length."""

    id = "cq2_length_arm"
    title = "An arm learns how long it should be"
    source = "CQ2 5.3.1"
    paper = "the tip comes within 0.001 of its goal in 100 steps (video only)"
    criteria = {
        size: "with a free length the distance is below 0.001 within 100 steps; with a fixed length it is not in 200 "
        "steps"
        for size in Size
    }
    notes = "The size, material, muscles and goal are ours"

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return both runs, the same at both sizes."""
        return [
            Runs("arm_length_free", 0.4, "codesign", SCENE),
            Runs("arm_length_fixed", 0.2, "control", SCENE, ("unknowns={}", "optimizer.adam.max_iterations=200")),
        ]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return variant, step, distance [m], length [m]."""
        return table_of(
            {
                "variant": name.rpartition("_")[2],
                "step": k,
                "distance": float(np.sqrt(gap)),
                "length": float(run.history[LENGTH][k]) if LENGTH in run.history else START,
            }
            for name, folder in folders.items()
            for run in runs_below(folder)
            for k, gap in enumerate(run.history["tip"])
        )

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw both distances, with a line at 0.001, and the length."""
        picture = new_figure(6.6, 3.2)
        distance, length = picture.subplots(1, 2)
        for colour, name in zip(COLOURS, dict.fromkeys(table["variant"]), strict=False):
            rows = table["variant"] == name
            distance.plot(table["step"][rows], table["distance"][rows], color=colour, label=LABELS[name])
            length.plot(table["step"][rows], table["length"][rows], color=colour)
        distance.axhline(NEAR, color=GREY, lw=1.0, ls="--", label="paper: 0.001 by step 100")
        distance.set_yscale("log")
        distance.set_ylabel("distance of the tip [m]")
        length.set_ylabel("length of the arm [m]")
        picture.legend(*distance.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        for axes in (distance, length):
            axes.set_xlabel("step")
        titled(distance, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge when the tip is near its goal."""
        free, fixed = (table["distance"][table["variant"] == name] for name in ("free", "fixed"))
        near, enough = first_below(free, NEAR), len(fixed) > 200
        return Verdict.of({
            f"free: below 0.001 at step {near}, ends at {free[-1]:.2g}": near is not None and near <= 100,
            f"fixed: {fixed.min():.2g} at best in {len(fixed) - 1} steps": enough and bool(fixed.min() > NEAR),
        })  # fmt: skip

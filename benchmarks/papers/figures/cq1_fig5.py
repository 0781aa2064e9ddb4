"""CQ1 Fig 5: the arm of two links at rest, and where each design ends, coloured by stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.histories import runs_below
from benchmarks.papers.families.violations import DESIGNED
from benchmarks.papers.figure import Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.figures.cq1_fig8 import TwoLinkArm
from benchmarks.papers.machinery.runs import Runs
from cqrun.build.particles import sample
from cqrun.figures.colours import material_of
from cqrun.figures.run_data import read_run
from cqrun.figures.style import GREY, TRUTH, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

ARMS = TwoLinkArm()
GOAL = (0.7, 0.5)
AT_REST = "at rest"
TOUCHES = 0.0101
"""The distance that the constraint allows [m], plus one per cent, because solutions lie on its edge."""


class Poses(Figure):
    """Four poses of the arm; the tasks are those of Fig 8."""

    id = "cq1_fig5"
    title = "Where each arm ends, coloured by its stiffness"
    source = "CQ1 Fig 5"
    paper = "the co-designed arm touches the goal and is soft where it bends; the arm of 300 % does not get there"
    notes = "The solver is ours, as in Fig 8, and brings the arm of 300 % to the goal, too"
    criteria = {
        size: "the co-designed arm's tip ends within 0.0101 m of the goal, and that of the 300 % arm does not; the "
        "co-designed arm's stiffness varies in space"
        for size in Size
    }

    def tasks(self, size: Size) -> Sequence[Runs]:
        """Return the tasks of Fig 8."""
        return ARMS.tasks(size)

    def table(self, folders: Folders, size: Size) -> Table:
        """Return pose, x, y [m], E, tip (1 for the tip's particles)."""
        rows: list[dict[str, object]] = []
        for label in ARMS.labels:
            if ARMS.task_name(label) not in folders:
                continue
            (each,) = runs_below(folders[ARMS.task_name(label)])
            if not each.has_trajectory:
                continue
            run = read_run(each.path)
            x, particles = run.trajectory().fields["x"], sample(run.scene)
            stiffness = material_of(run, particles, "stiffness")
            tip = np.zeros(len(stiffness), bool)
            tip[particles.groups("arm")["tip"]] = True
            poses = {label: x[-1]} if label != DESIGNED else {AT_REST: x[0], label: x[-1]}
            for pose, positions in poses.items():
                shown = np.full(len(stiffness), np.nan) if pose == AT_REST else stiffness
                rows += (
                    {"pose": pose, "x": float(p[0]), "y": float(p[1]), "E": float(e), "tip": float(t)}
                    for p, e, t in zip(positions, shown, tip, strict=True)
                )
        return table_of(rows)

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw the poses side by side on one scale of colours."""
        poses = list(dict.fromkeys(table["pose"]))
        picture = new_figure(2.2 * len(poses) + 0.9, 3.3)
        panels = picture.subplots(1, len(poses), sharey=True, squeeze=False)[0]
        for axes, pose in zip(panels, poses, strict=True):
            rows = table["pose"] == pose
            positions, area = (table["x"][rows], table["y"][rows]), 5 if rows.sum() > 600 else 16
            if pose == AT_REST:
                axes.scatter(*positions, color=GREY, s=area)
            else:
                dots = axes.scatter(*positions, c=table["E"][rows], s=area, vmin=3, vmax=40)
            axes.set_xlabel("x [m]")
            axes.plot(*GOAL, "+", color=TRUTH, ms=11, mew=2)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(pose)
        panels[0].set_ylabel("y [m]")
        bar = picture.colorbar(dots, ax=panels, shrink=0.8)
        bar.set_label("Young's modulus; the cross is the goal")
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how near to the goal each tip ends."""
        gaps = {}
        for pose in dict.fromkeys(table["pose"]):
            tip = (table["pose"] == pose) & (table["tip"] == 1)
            gaps[pose] = float(np.hypot(table["x"][tip].mean() - GOAL[0], table["y"][tip].mean() - GOAL[1]))
        spread = float(np.std(table["E"][table["pose"] == DESIGNED]))
        stiff = gaps["fixed 300 %"]
        return Verdict.of({
            f"the co-designed arm touches the goal: {gaps[DESIGNED]:.4f} m": gaps[DESIGNED] <= TOUCHES,
            f"the 300 % arm does not: {stiff:.4f} m": stiff > TOUCHES,
            f"E varies by {spread:.2g} (standard deviation) in the co-designed arm": spread > 0.1,
        })  # fmt: skip

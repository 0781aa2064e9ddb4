"""CQ1 Fig 5: the arm of two links at rest, and where each design ends, coloured by stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.histories import runs_below
from benchmarks.papers.families.violations import DESIGNED
from benchmarks.papers.figure import Figure, Size, Table, Verdict, judged, stacked
from benchmarks.papers.figures.cq1_fig8 import TwoLinkArm
from benchmarks.papers.machinery.work import Found, Work
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
"""Distance that the constraint allows [m], and one per cent for the edge that solutions lie on."""


class Poses(Figure):
    """Four poses of the arm; the work is that of Fig 8."""

    id = "cq1_fig5"
    title = "Where each arm ends, coloured by its stiffness"
    source = "CQ1 Fig 5"
    paper = "the co-designed arm touches the goal and is soft where it bends; the one of 300 % does not get there"
    left_open = "the solver, as in Fig 8, which brings the arm of 300 % to the goal too"
    tolerance = {
        size: "the co-designed arm's tip ends within .0101 m of the goal, that of 300 % does not; its "
        "stiffness differs in space"
        for size in Size
    }

    def work(self, size: Size) -> Sequence[Work]:
        """Return the work of Fig 8."""
        return ARMS.work(size)

    def table(self, found: Found, size: Size) -> Table:
        """Return pose, x, y [m], E, tip (1 for the tip's particles)."""
        rows: list[dict[str, object]] = []
        for label in ARMS.labels:
            if ARMS.work_name(label) not in found:
                continue
            (each,) = runs_below(found[ARMS.work_name(label)])
            run = read_run(each.path)
            if not run.has("trajectory.h5"):
                continue
            x, particles = run.trajectory().fields["x"], sample(run.scene)
            stiffness = material_of(run, particles, "stiffness")
            tip = np.zeros(len(stiffness), bool)
            tip[particles.groups("arm")["tip"]] = True
            poses = {label: x[-1]} if label != DESIGNED else {AT_REST: x[0], label: x[-1]}
            for pose, places in poses.items():
                shown = np.full(len(stiffness), np.nan) if pose == AT_REST else stiffness
                rows += (
                    {"pose": pose, "x": float(p[0]), "y": float(p[1]), "E": float(e), "tip": float(t)}
                    for p, e, t in zip(places, shown, tip, strict=True)
                )
        return stacked(iter(rows))

    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Draw the poses side by side on one scale of colours."""
        poses = list(dict.fromkeys(table["pose"]))
        picture = new_figure(2.2 * len(poses) + 0.9, 3.3)
        panels = picture.subplots(1, len(poses), sharey=True, squeeze=False)[0]
        for axes, pose in zip(panels, poses, strict=True):
            own = table["pose"] == pose
            places, area = (table["x"][own], table["y"][own]), 5 if own.sum() > 600 else 16
            if pose == AT_REST:
                axes.scatter(*places, color=GREY, s=area)
            else:
                dots = axes.scatter(*places, c=table["E"][own], s=area, vmin=3, vmax=40)
            axes.set_xlabel("x [m]")
            axes.plot(*GOAL, "+", color=TRUTH, ms=11, mew=2)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(pose)
        panels[0].set_ylabel("y [m]")
        bar = picture.colorbar(dots, ax=panels, shrink=0.8)
        bar.set_label("Young's modulus; the cross is the goal")
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how near each tip ends."""
        gaps = {}
        for pose in dict.fromkeys(table["pose"]):
            own = (table["pose"] == pose) & (table["tip"] == 1)
            gaps[pose] = float(np.hypot(table["x"][own].mean() - GOAL[0], table["y"][own].mean() - GOAL[1]))
        spread = float(np.std(table["E"][table["pose"] == DESIGNED]))
        stiff = gaps["fixed 300 %"]
        return judged({
            f"co-design touches the goal: {gaps[DESIGNED]:.4f} m": gaps[DESIGNED] <= TOUCHES,
            f"300 % does not: {stiff:.4f} m": stiff > TOUCHES,
            f"E varies by {spread:.2g} (sd) in the co-designed arm": spread > 0.1,
        })  # fmt: skip

"""CQ1 Fig 6: a quadruped walks to a goal."""

import numpy as np

from benchmarks.papers.figure import Size, Table, Verdict, judged
from benchmarks.papers.frames import Frames
from benchmarks.papers.work import Runs

GOAL = np.array([1.4, 0.4, 0.5])
QUICK = ("bodies.quadruped.sampling.lattice.count=5", "time.substeps=2", "optimizer.sgd.max_iterations=12")


class Quadruped(Frames):
    """Frames of the seed that ends nearest to its goal."""

    id = "cq1_fig6"
    title = "A quadruped walks to a goal"
    source = "CQ1 Fig 6"
    paper = "frames of a walk; tens or hundreds of iterations; no number is printed"
    tolerance = {
        Size.QUICK: "the head ends nearer to its goal than it began",
        Size.PAPER: "the head ends within .15 m of its goal after 100 iterations",
    }
    name, term, greatest, body, group = "quadruped_walk", "head", False, "quadruped", "head"

    def work(self, size: Size) -> list[Runs]:
        """Return the seeds: quick, one of 3,125 particles; else three of 84,375."""
        if size is Size.QUICK:
            return [Runs(self.name, 2.0, "control", "control/quadruped", QUICK, 1)]
        return [Runs(self.name, 100.0, "control", "control/quadruped", (), 3)]

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how near to the goal the head ends."""
        gap = np.linalg.norm(np.stack([table[axis] for axis in "xyz"], axis=1) - GOAL, axis=1)
        told = f"head to goal {gap[0]:.2f} -> {gap[-1]:.2f} m"
        return judged({told: bool(gap[-1] < (gap[0] if size is Size.QUICK else 0.15))})

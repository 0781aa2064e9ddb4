"""CQ1 Fig 4: a biped walks."""

from collections.abc import Sequence

from benchmarks.papers.families.frames import Frames
from benchmarks.papers.families.integrity import INTACT, checks
from benchmarks.papers.figure import Size, Table, Verdict
from benchmarks.papers.machinery.runs import Runs

QUICK = ("bodies.biped.sampling.lattice.count=10", "world.dx=0.04", "optimizer.sgd.max_iterations=60")
LENGTH = 0.6
"""Of the body [m]."""


class Biped(Frames):
    """Frames of the seed that walks farthest."""

    id = "cq1_fig4"
    title = "A biped walks"
    source = "CQ1 Fig 4"
    paper = "onion-skin frames of 600 steps: a walk to the right; no number is printed"
    criteria = {
        Size.QUICK: f"the head of the best seed moves farther than 0.2 m, a third of the body's length; {INTACT}",
        Size.PAPER: f"the head of the best seed moves farther than the body's length, 0.6 m; {INTACT}",
    }
    notes = (
        "With the paper's learning rate of 0.03, six of ten seeds only lean forward. Here the rate is 1, and the "
        "gradient is clipped to a length of 0.1"
    )
    name, term, body, group = "biped_walk", "far", "biped", "head"

    def tasks(self, size: Size) -> Sequence[Runs]:
        """Return the seeds."""
        if size is Size.QUICK:
            return [Runs(self.name, 2.0, "control", "control/biped", QUICK, 4)]
        return [Runs(self.name, 7.0, "control", "control/biped", (), 10)]

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how far the head moves, and whether the body holds together."""
        distance = float(table["x"][-1] - table["x"][0])
        wanted = LENGTH / 3.0 if size is Size.QUICK else LENGTH
        verdict = Verdict.of({f"the head moves {distance:.2f} m, asked {wanted:g}": distance > wanted})
        return verdict.also(checks(table))

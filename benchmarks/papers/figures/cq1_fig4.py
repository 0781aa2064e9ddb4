"""CQ1 Fig 4: a biped walks."""

from benchmarks.papers.families.frames import Frames
from benchmarks.papers.families.integrity import WHOLE, checks
from benchmarks.papers.figure import Size, Table, Verdict, judged, lowered
from benchmarks.papers.machinery.work import Runs

QUICK = ("bodies.biped.sampling.lattice.count=10", "world.dx=0.04", "optimizer.sgd.max_iterations=60")
LENGTH = 0.6
"""Of the body [m]."""


class Biped(Frames):
    """Frames of the seed that walks farthest."""

    id = "cq1_fig4"
    title = "A biped walks"
    source = "CQ1 Fig 4"
    paper = "onion-skin frames of 600 steps: a walk to the right; no number is printed"
    tolerance = {
        Size.QUICK: f"the head of the best seed comes farther than .2 m, a third of the body's length; {WHOLE}",
        Size.PAPER: f"the head of the best seed comes farther than the body's length, .6 m; {WHOLE}",
    }
    left_open = (
        "the learning rate: at the paper's .03 six of ten seeds only lean forward; here it is 1, with the gradient "
        "cut to a length of .1"
    )
    name, term, body, group = "biped_walk", "far", "biped", "head"

    def work(self, size: Size) -> list[Runs]:
        """Return the seeds."""
        if size is Size.QUICK:
            return [Runs(self.name, 2.0, "control", "control/biped", QUICK, 4)]
        return [Runs(self.name, 7.0, "control", "control/biped", (), 10)]

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how far the head came, and in how many pieces."""
        far = float(table["x"][-1] - table["x"][0])
        wanted = LENGTH / 3.0 if size is Size.QUICK else LENGTH
        return lowered(judged({f"the head went {far:.2f} m, asked {wanted:g}": far > wanted}), checks(table))

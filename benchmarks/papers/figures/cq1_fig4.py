"""CQ1 Fig 4: a biped walks."""

from benchmarks.papers.figure import Size, Table, Verdict, judged
from benchmarks.papers.frames import Frames
from benchmarks.papers.work import Runs

QUICK = ("bodies.biped.sampling.lattice.count=10", "optimizer.sgd.max_iterations=60")


class Biped(Frames):
    """Frames of the seed that walks farthest."""

    id = "cq1_fig4"
    title = "A biped walks"
    source = "CQ1 Fig 4"
    paper = "onion-skin frames of 600 steps: a walk to the right; no number is printed"
    tolerance = {
        Size.QUICK: "the head of the best seed comes farther than .2 m",
        Size.PAPER: "the head of the best seed comes farther than .6 m, the length of the body",
    }
    left_open = (
        "the steps: with .03 times the gradient six of ten seeds lean; here longer, and shortened where it walks"
    )
    name, term, body, group = "biped_walk", "far", "biped", "head"

    def work(self, size: Size) -> list[Runs]:
        """Return the seeds."""
        if size is Size.QUICK:
            return [Runs(self.name, 1.0, "control", "control/biped", QUICK, 4)]
        return [Runs(self.name, 12.0, "control", "control/biped", (), 10)]

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how far the head came."""
        far = float(table["x"][-1] - table["x"][0])
        wanted = 0.2 if size is Size.QUICK else 0.6
        return judged({f"the head went {far:.2f} m, asked {wanted:g}": far > wanted})

"""CQ2 Fig 10: an arm in 3D swings up to its goal and comes to rest there, its stiffness designed or fixed."""

from benchmarks.papers.families.distances import SINGLE
from benchmarks.papers.families.violations import DESIGNED, Violations, effort_ratio
from benchmarks.papers.figure import Size, Table, Verdict, judged


class SwingingArm(Violations):
    """Violation against the iteration for three arms."""

    id = "cq2_fig10"
    title = "An arm in 3D swings up, its stiffness designed or fixed"
    source = "CQ2 Fig 10"
    paper = (
        "co-design .12 -> .0017 in 72 iterations, where it stops; fixed 100 % 7e-4 and 133 % .047 after 97; "
        "effort below 75 % of the fixed arm's"
    )
    tolerance = {
        Size.QUICK: "the co-designed arm meets the constraints (1e-4); the fixed 133 % arm does not",
        Size.PAPER: "in the paper's 97 iterations the co-designed arm comes below 1e-4 with three quarters of the "
        "fixed 100 % arm's effort, or at most 10 % more than that; the fixed 133 % arm stalls at .047, or 10 % less",
    }
    left_open = (
        "the control step, strength, goal, thresholds and sizes of the links; the solver, which is ours, and stalls "
        "with neither fixed arm at either size. The paper-size run is of the solver as it was before it left out "
        "corrections that, to judge by the gradients, could not help. Efforts still fall after 97 iterations, and how "
        "far depends on the way there: without corrections they came to .095 and .128, a ratio of .742"
    )
    scene = "codesign/arm_3d"
    modulus = "bodies.arm.material.elastic.neo_hookean.youngs_modulus"
    fixed = {"fixed 100 %": 300.0, "fixed 133 %": 400.0}
    quick = (
        "bodies.arm.sampling.lattice.count=5", "world.dx=0.06666666666666667", "time.substeps=40",
        "optimizer.sqp.max_iterations=60",
    )  # fmt: skip
    paper_size = SINGLE
    minutes = {Size.QUICK: 1.2, Size.PAPER: 35.0}
    printed = {
        DESIGNED: [(0, 0.12), (72, 1.7e-3)],
        "fixed 100 %": [(97, 7e-4)],
        "fixed 133 %": [(97, 4.7e-2)],
    }
    tolerated = 1e-4

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the least violation, and at the paper's size the effort."""
        least = float(self.violation(table, DESIGNED).min())
        checks = {f"co-design comes to {least:.2g}, wanted {self.tolerated:g}": least <= self.tolerated}
        checks |= self.stalls(table, "fixed 133 %", size)
        if size is Size.PAPER:
            checks |= effort_ratio(self, table, "fixed 100 %", 0.75, 97)
        return judged(checks)

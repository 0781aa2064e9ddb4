"""CQ2 Fig 10: an arm in 3D swings up to its goal and comes to rest there, with designed or fixed stiffness."""

from benchmarks.papers.families.distances import SINGLE
from benchmarks.papers.families.violations import DESIGNED, Violations, effort_ratio
from benchmarks.papers.figure import Size, Table, Verdict


class SwingingArm(Violations):
    """Violation against the iteration for three arms."""

    id = "cq2_fig10"
    title = "An arm in 3D swings up, its stiffness designed or fixed"
    source = "CQ2 Fig 10"
    paper = (
        "co-design goes from 0.12 to 0.0017 in 72 iterations, where it stops; after 97 iterations fixed 100 % is at "
        "7e-4 and fixed 133 % at 0.047; the effort is below 75 % of the fixed arm's"
    )
    criteria = {
        Size.QUICK: "the co-designed arm meets the constraints (1e-4); the fixed 133 % arm does not",
        Size.PAPER: "within the paper's 97 iterations the co-designed arm comes below 1e-4, with three quarters of "
        "the fixed 100 % arm's effort, or at most 10 % more than that; the fixed 133 % arm stalls at 0.047, or at "
        "most 10 % below that",
    }
    notes = (
        "We chose the control step, strength, goal, thresholds and sizes of the links. The solver is ours, and stalls "
        "with neither fixed arm at either size. The paper-size run used an earlier version of the solver; today's "
        "skips corrections that cannot help, as the gradients show. Efforts still fall after 97 iterations, and how "
        "far depends on the path: without corrections they came to 0.095 and 0.128, a ratio of 0.742"
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
        checks = {f"co-design comes to {least:.2g}, asked {self.tolerated:g}": least <= self.tolerated}
        checks |= self.stalls(table, "fixed 133 %", size)
        if size is Size.PAPER:
            checks |= effort_ratio(self, table, "fixed 100 %", 0.75, 97)
        return Verdict.of(checks)

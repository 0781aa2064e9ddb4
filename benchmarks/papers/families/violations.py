"""Figures of how far constraints are violated, against the iteration (CQ1 Fig 8, CQ2 Fig 10)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.families.histories import first_below, runs_below
from benchmarks.papers.figure import Figure, Folders, Size, Table, table_of
from benchmarks.papers.machinery.runs import Runs
from cqrun.figures.style import COLOURS, GREY, new_figure, titled
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

SMALLEST = 1e-7
"""Smaller violations are drawn as this."""

DESIGNED = "co-design"


class Violations(Figure):
    """Violation and effort of a co-designed robot beside robots whose stiffness is fixed."""

    scene: ClassVar[str]  # below scenes/
    modulus: ClassVar[str]  # path of the stiffness
    fixed: ClassVar[Mapping[str, float]]  # label -> Young's modulus of the robots that are not designed
    quick: ClassVar[tuple[str, ...]]  # overrides of the scene
    paper_size: ClassVar[tuple[str, ...]] = ()
    minutes: ClassVar[Mapping[Size, float]]  # for each robot
    printed: ClassVar[Mapping[str, Sequence[tuple[float, float]]]]  # label -> (iteration, violation)
    tolerated: ClassVar[float]  # the constraints are met below this violation

    def tasks(self, size: Size) -> Sequence[Runs]:
        """Return a run for each robot."""
        overrides, minutes = self.quick if size is Size.QUICK else self.paper_size, self.minutes[size]
        designed = Runs(self.task_name(DESIGNED), minutes, "codesign", self.scene, overrides)
        fixed = {label: ("unknowns={}", f"{self.modulus}={value:g}") for label, value in self.fixed.items()}
        return [
            designed,
            *(
                Runs(self.task_name(label), minutes, "control", self.scene, (*overrides, *more))
                for label, more in fixed.items()
            ),
        ]

    def task_name(self, label: str) -> str:
        """Return the name of a robot's task."""
        return f"{self.scene.rpartition('/')[2]}_{''.join(c if c.isalnum() else '_' for c in label)}"

    @property
    def labels(self) -> list[str]:
        """The robots, the designed one first."""
        return [DESIGNED, *self.fixed]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return robot, iteration, violation, effort, seconds."""
        return table_of(
            {
                "robot": label,
                "iteration": k,
                "violation": float(violation),
                "effort": float(run.history["effort"][k]),
                "seconds": float(run.seconds[k]),
            }
            for label in self.labels
            if self.task_name(label) in folders
            for run in runs_below(folders[self.task_name(label)])
            for k, violation in enumerate(run.history["violation"])
        )

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw violations on a logarithmic axis, with the paper's as marks, and efforts beside them."""
        picture = new_figure(8.2, 3.6)
        left, right = picture.subplots(1, 2, width_ratios=(2, 1))
        for colour, label in zip(COLOURS, self.labels, strict=False):
            rows = table["robot"] == label
            if not rows.any():
                continue
            iteration, violation = table["iteration"][rows], np.maximum(table["violation"][rows], SMALLEST)
            left.plot(iteration, violation, color=colour, label=label)
            if label in self.printed:
                x, y = zip(*self.printed[label], strict=True)
                left.plot(x, y, "D", color=colour, mec="white", ms=6, label=f"{label}, paper")
            right.plot(iteration, table["effort"][rows], color=colour)
        left.axhline(self.tolerated, color=GREY, lw=0.8, ls=":", label=f"asked: {self.tolerated:g}")
        left.set_yscale("log")
        left.set_ylabel(f"violation of the constraints, or {SMALLEST:g} if less")
        right.set_ylabel("effort")
        for axes in (left, right):
            axes.set_xlabel("iteration")
        left.legend(fontsize=7)
        titled(left, self.title)
        return picture

    def violation(self, table: Table, label: str) -> Array:
        """Return the violations of a robot, by iteration."""
        return np.asarray(table["violation"][table["robot"] == label])

    def least_effort(self, table: Table, label: str, iterations: float = np.inf) -> float | None:
        """Return a robot's least effort in its first iterations that meet the constraints; None if none does."""
        met = (table["violation"] <= self.tolerated) & (table["iteration"] <= iterations)
        rows = (table["robot"] == label) & met
        return float(table["effort"][rows].min()) if rows.any() else None

    def stalls(self, table: Table, label: str, size: Size) -> dict[str, bool]:
        """Return the check that a robot does not come to meet the constraints, as in the paper."""
        least = float(self.violation(table, label).min(initial=np.inf))
        if size is Size.QUICK:
            return {f"{label} stalls: {least:.2g} at best": least > self.tolerated}
        printed = min(violation for _, violation in self.printed[label])
        return {f"{label} stalls: {least:.2g} at best, paper {printed:.2g}": least >= 0.9 * printed}

    def designed_is_first(self, table: Table) -> dict[str, bool]:
        """Return the check that the designed robot meets the constraints, and no fixed one meets them sooner."""
        when = {label: first_below(self.violation(table, label), self.tolerated) for label in self.labels}
        designed = when[DESIGNED]
        text = ", ".join(f"{label} {'never' if k is None else k}" for label, k in when.items())
        first = designed is not None and all(k is None or k >= designed for k in when.values())
        return {f"no fixed arm meets the constraints ({self.tolerated:g}) sooner: {text}": first}


def effort_ratio(figure: Violations, table: Table, label: str, printed: float, iterations: int) -> dict[str, bool]:
    """Return the check that the designed robot's effort over a fixed one's is the paper's ratio, or a tenth more.

    It must be below 1 in any case: that the designed robot needs less is the claim. Efforts keep falling, so the least
    efforts are compared that meet the constraints within as many iterations as the paper shows.
    """

    def ratio(last: float) -> float | None:
        designed, fixed = figure.least_effort(table, DESIGNED, last), figure.least_effort(table, label, last)
        return None if designed is None or fixed is None else designed / fixed

    early, final = ratio(iterations), ratio(np.inf)
    if early is None or final is None:
        return {f"effort over {label}: not both meet the constraints in {iterations} iterations": False}
    at_end = f" ({final:.3f} at the end of the searches)" if final != early else ""
    text = f"least effort in {iterations} iterations {early:.3f} of {label}{at_end}, paper {printed:g}"
    return {text: early < min(1.0, 1.1 * printed)}

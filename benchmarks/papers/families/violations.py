"""A family of figures: how far constraints are violated, against the iteration (CQ1 Fig 8, CQ2 Fig 10)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.families.histories import first_below, runs_below
from benchmarks.papers.figure import Figure, Size, Table, stacked
from benchmarks.papers.machinery.work import Found, Runs, Work
from cqrun.figures.style import COLOURS, GREY, new_figure, titled
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

SMALLEST = 1e-7
"""Violations are drawn no smaller than this."""

DESIGNED = "co-design"


class Violations(Figure):
    """Violation and effort of a co-designed robot beside robots whose stiffness is fixed.

    Attributes:
        scene: below scenes/.
        modulus: path of the stiffness.
        fixed: label -> Young's modulus of the robots that are not designed.
        quick, paper_size: overrides of the scene.
        minutes: of a robot, by size.
        printed: label -> (iteration, violation) points that the paper shows.
        tolerated: violation at which the constraints are called met.
    """

    scene: ClassVar[str]
    modulus: ClassVar[str]
    fixed: ClassVar[Mapping[str, float]]
    quick: ClassVar[tuple[str, ...]]
    paper_size: ClassVar[tuple[str, ...]] = ()
    minutes: ClassVar[Mapping[Size, float]]
    printed: ClassVar[Mapping[str, Sequence[tuple[float, float]]]]
    tolerated: ClassVar[float]

    def work(self, size: Size) -> Sequence[Work]:
        """Return a run for each robot."""
        small = self.quick if size is Size.QUICK else self.paper_size
        minutes = self.minutes[size]
        return [
            Runs(self.work_name(DESIGNED), minutes, "codesign", self.scene, small),
            *(
                Runs(self.work_name(label), minutes, "control", self.scene,
                     (*small, "unknowns={}", f"{self.modulus}={value:g}"))
                for label, value in self.fixed.items()
            ),
        ]  # fmt: skip

    def work_name(self, label: str) -> str:
        """Return the folder of a robot's work."""
        return f"{self.scene.rpartition('/')[2]}_{''.join(c if c.isalnum() else '_' for c in label)}"

    @property
    def labels(self) -> list[str]:
        """The robots, the designed one first."""
        return [DESIGNED, *self.fixed]

    def table(self, found: Found, size: Size) -> Table:
        """Return robot, iteration, violation, effort, seconds."""
        return stacked(
            {
                "robot": label,
                "iteration": k,
                "violation": float(violation),
                "effort": float(run.history["effort"][k]),
                "seconds": float(run.seconds[k]),
            }
            for label in self.labels
            if self.work_name(label) in found
            for run in runs_below(found[self.work_name(label)])
            for k, violation in enumerate(run.history["violation"])
        )

    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Draw violations on a logarithmic axis, the paper's as marks, and efforts beside them."""
        picture = new_figure(8.2, 3.6)
        left, right = picture.subplots(1, 2, width_ratios=(2, 1))
        for colour, label in zip(COLOURS, self.labels, strict=False):
            own = table["robot"] == label
            if not own.any():
                continue
            left.plot(table["iteration"][own], np.maximum(table["violation"][own], SMALLEST), color=colour, label=label)
            if label in self.printed:
                x, y = zip(*self.printed[label], strict=True)
                left.plot(x, y, "D", color=colour, mec="white", ms=6, label=f"{label}, paper")
            right.plot(table["iteration"][own], table["effort"][own], color=colour)
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
        """Return the least effort of a robot among its first iterates that meet the constraints; None if none does."""
        met = (table["violation"] <= self.tolerated) & (table["iteration"] <= iterations)
        own = (table["robot"] == label) & met
        return float(table["effort"][own].min()) if own.any() else None

    def stalls(self, table: Table, label: str, size: Size) -> dict[str, bool]:
        """Return the check that a robot does not come to meet the constraints, as the paper's did not."""
        least = float(self.violation(table, label).min(initial=np.inf))
        if size is Size.QUICK:
            return {f"{label} stalls: {least:.2g} at best": least > self.tolerated}
        printed = min(violation for _, violation in self.printed[label])
        return {f"{label} stalls: {least:.2g} at best, paper {printed:.2g}": least >= 0.9 * printed}

    def compared(self, table: Table) -> dict[str, bool]:
        """Return the check that the designed robot meets the constraints, and no fixed one is there sooner."""
        when = {label: first_below(self.violation(table, label), self.tolerated) for label in self.labels}
        designed = when[DESIGNED]
        told = ", ".join(f"{label} {'never' if k is None else k}" for label, k in when.items())
        first = designed is not None and all(k is None or k >= designed for k in when.values())
        return {f"met ({self.tolerated:g}) by no fixed arm sooner: {told}": first}


def effort_ratio(figure: Violations, table: Table, label: str, printed: float, iterations: int) -> dict[str, bool]:
    """Return the check that the designed robot needs the paper's part of a fixed one's effort, or at most 10 % more.

    In no case as much as that one does: that it needs less is the claim. Efforts fall on and on, so the least ones are
    compared that meet the constraints within as many iterations as the paper shows.
    """

    def ratio(upto: float) -> float | None:
        ours, theirs = figure.least_effort(table, DESIGNED, upto), figure.least_effort(table, label, upto)
        return None if ours is None or theirs is None else ours / theirs

    soon, last = ratio(iterations), ratio(np.inf)
    if soon is None or last is None:
        return {f"effort over {label}: not both meet the constraints in {iterations} iterations": False}
    then = f" ({last:.3f} where their searches end)" if last != soon else ""
    told = f"least effort in {iterations} iterations {soon:.3f} of {label}{then}, paper {printed:g}"
    return {told: soon < min(1.0, 1.1 * printed)}

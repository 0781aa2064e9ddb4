"""CQ1 V-A, inset: how dense was the ball that hit the other one?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.figure import Figure, Size, Table, Verdict, judged, stacked
from benchmarks.papers.histories import runs_below
from benchmarks.papers.work import Found, Runs, Work
from cqrun.figures.style import COLOURS, GREY, TRUTH, new_figure, titled, whole_ticks

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

DENSITY = "bodies.a.material.density"
PRINTED = 2.26
SEEDS = {Size.QUICK: 3, Size.PAPER: 10}


class Inference(Figure):
    """The density of ball A against the iteration, for several samplings of the two balls."""

    id = "cq1_inference"
    title = "The density of a ball, from where another ends that it hits"
    source = "CQ1 V-A"
    paper = "relative density 2.26, one sampling of unknown seed"
    tolerance = {
        Size.QUICK: "every sampling finds a density between 2 and 2.6",
        Size.PAPER: "2.26 lies between the least and the greatest of ten samplings, their mean within 10 %",
    }
    left_open = "the sampling: the densities differ from seed to seed"

    def work(self, size: Size) -> Sequence[Work]:
        """Return a fit for each sampling."""
        return [
            Runs(
                f"collision_{seed}", 0.3, "sysid", "sysid/collision",
                (f"bodies.a.sampling.random.seed={2 * seed}", f"bodies.b.sampling.random.seed={2 * seed + 1}"),
            )
            for seed in range(SEEDS[size])
        ]  # fmt: skip

    def table(self, found: Found, size: Size) -> Table:
        """Return sampling, iteration, density, loss [m^2]."""
        return stacked(
            {"sampling": int(name.rpartition("_")[2]), "iteration": k, "density": float(density), "loss": float(loss)}
            for name, folder in found.items()
            for run in runs_below(folder)
            for k, (density, loss) in enumerate(zip(run.history[f"value:{DENSITY}"], run.history["loss"], strict=True))
        )

    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Draw the densities; the paper's as a line."""
        picture = new_figure(5.2, 3.4)
        axes = picture.add_subplot()
        for sampling in np.unique(table["sampling"]):
            own = table["sampling"] == sampling
            axes.plot(table["iteration"][own], table["density"][own], color=COLOURS[0], lw=1.0, marker=".", ms=4)
        axes.axhline(PRINTED, color=TRUTH, lw=1.0, ls="--", label=f"paper: {PRINTED}")
        axes.axhline(1.0, color=GREY, lw=0.8, ls=":", label="start")
        whole_ticks(axes.xaxis)
        axes.set_xlabel("iteration")
        axes.set_ylabel("density of ball A")
        axes.legend()
        titled(axes, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the densities that were found."""
        ends = np.array([table["density"][table["sampling"] == s][-1] for s in np.unique(table["sampling"])])
        told = f"{ends.mean():.3f} +- {ends.std(ddof=1):.3f} ({ends.min():.3f} to {ends.max():.3f})"
        if len(ends) < SEEDS[size]:
            return judged({f"{len(ends)} of {SEEDS[size]} samplings: {told}": False})
        if size is Size.QUICK:
            return judged({f"between 2 and 2.6: {told}": bool(np.all((ends > 2.0) & (ends < 2.6)))})
        return judged({
            f"{PRINTED} lies inside: {told}": bool(ends.min() <= PRINTED <= ends.max()),
            f"mean {ends.mean():.3f} within 10 %": bool(abs(ends.mean() / PRINTED - 1.0) <= 0.1),
        })  # fmt: skip

"""CQ1 V-A, inset: how dense is the ball that hits the other one?"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.histories import runs_below
from benchmarks.papers.figure import Column, Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.runs import Runs
from cqrun.figures.run_data import read_run
from cqrun.figures.style import COLOURS, GREY, TRUTH, new_figure, titled, whole_ticks

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

DENSITY = "bodies.a.material.density"
PRINTED = 2.26
GOAL = (0.68, 0.52)
"""Where the middle of ball B has to end [m], as in the scene."""

SEEDS = {Size.QUICK: 3, Size.PAPER: 10}


class Inference(Figure):
    """The density of ball A against the iteration, for several samplings of the two balls."""

    id = "cq1_inference"
    title = "The density of a ball, from where it pushes another one"
    source = "CQ1 V-A"
    paper = "relative density 2.26, one sampling of unknown seed"
    criteria = {
        Size.QUICK: "with the density found, ball B ends within 0.01 m of its goal, in every sampling",
        Size.PAPER: "2.26 lies between the least and the greatest of ten samplings, and their mean is within 10 % of "
        "it",
    }
    notes = (
        "The sampling is ours, and the density differs from seed to seed. We use L-BFGS; CQ1 uses gradient descent. "
        "The substep is the paper's, and the density depends on it: with half the substep, ten samplings have a mean "
        "of 2.42 and range from 2.30 to 2.51 (benchmarks/measured/collision_seeds.json)"
    )

    def tasks(self, size: Size) -> Sequence[Runs]:
        """Return a fit for each sampling."""
        return [
            Runs(
                f"collision_{seed}", 0.2, "sysid", "sysid/collision",
                (f"bodies.a.sampling.random.seed={2 * seed}", f"bodies.b.sampling.random.seed={2 * seed + 1}"),
            )
            for seed in range(SEEDS[size])
        ]  # fmt: skip

    def table(self, folders: Folders, size: Size) -> Table:
        """Return the fits, then the motions.

        Fits: sampling, iteration, density, loss [m^2]. Motions: sampling, time [s], and the balls' middles [m].
        """
        fits = [(int(n.rpartition("_")[2]), run) for n, folder in folders.items() for run in runs_below(folder)]
        learned = (
            {"sampling": sampling, "iteration": k, "density": float(density), "loss": float(loss)}
            for sampling, run in fits
            for k, (density, loss) in enumerate(zip(run.history[f"value:{DENSITY}"], run.history["loss"], strict=True))
        )
        moved = (
            {"sampling": sampling, "time": float(time)} | {
                f"{ball}_{axis}": float(middle)
                for ball, particles in trajectory.bodies.items()
                for axis, middle in zip("xy", x[particles].mean(axis=0), strict=True)
            }
            for sampling, run in fits
            if run.has_trajectory
            for trajectory in [read_run(run.path).trajectory()]
            for time, x in zip(trajectory.time, trajectory.fields["x"], strict=True)
        )  # fmt: skip
        return table_of(chain(learned, moved))

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw the densities, the paper's as a line; and the paths of both balls with the densities found."""
        picture = new_figure(8.4, 3.4)
        axes, plane = picture.subplots(1, 2)
        learned = np.isfinite(table["iteration"])
        for sampling in np.unique(table["sampling"]):
            fit, motion = ((table["sampling"] == sampling) & which for which in (learned, ~learned))
            axes.plot(table["iteration"][fit], table["density"][fit], color=COLOURS[0], lw=1.0, marker=".", ms=4)
            for colour, ball in zip(COLOURS[1:], "ab", strict=False):
                path = table[f"{ball}_x"][motion], table[f"{ball}_y"][motion]
                label = f"ball {ball.upper()}, with the density found" if sampling == table["sampling"][0] else None
                plane.plot(*path, color=colour, lw=1.0, marker=".", ms=3, label=label)
        axes.axhline(PRINTED, color=TRUTH, lw=1.0, ls="--", label=f"paper: {PRINTED}")
        axes.axhline(1.0, color=GREY, lw=0.8, ls=":", label="start")
        whole_ticks(axes.xaxis)
        axes.set_xlabel("iteration")
        axes.set_ylabel("density of ball A")
        plane.plot(*GOAL, "P", color=TRUTH, mec="white", ms=9, ls="none", label="goal of ball B")
        plane.set_aspect("equal", adjustable="datalim")
        plane.set_xlabel("x [m]")
        plane.set_ylabel("y [m]")
        for panel in (axes, plane):
            panel.legend()
        titled(axes, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the densities found."""
        ends, losses = _last(table, "density"), _last(table, "loss")
        text = f"{ends.mean():.3f} +- {ends.std(ddof=1):.3f} ({ends.min():.3f} to {ends.max():.3f})"
        if len(ends) < SEEDS[size]:
            return Verdict.of({f"{len(ends)} of {SEEDS[size]} samplings: {text}": False})
        if size is Size.QUICK:
            gap = np.sqrt(losses).max()
            return Verdict.of({f"B ends within {gap:.4f} m of its goal; densities {text}": bool(gap < 0.01)})
        return Verdict.of({
            f"{PRINTED} lies inside: {text}": bool(ends.min() <= PRINTED <= ends.max()),
            f"mean {ends.mean():.3f}, within 10 %": bool(abs(ends.mean() / PRINTED - 1.0) <= 0.1),
        })  # fmt: skip


def _last(table: Table, name: str) -> Column:
    """Return a column of each sampling's last iteration (S,)."""
    learned = np.isfinite(table["iteration"])
    return np.array([table[name][learned & (table["sampling"] == s)][-1] for s in np.unique(table["sampling"])])

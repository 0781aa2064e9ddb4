"""CQ1's arm in 3D: does it reach goals that it has not seen when it learned?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.distances import SINGLE
from benchmarks.papers.families.histories import Run, runs_below
from benchmarks.papers.figure import Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.runs import Runs
from benchmarks.papers.machinery.task import Task
from cqrun.figures.style import COLOURS, GREY, new_figure, titled
from cqrun.store.result import LearnedResult, read_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

QUICK = (
    "bodies.arm.sampling.lattice.count=5", "world.dx=0.06", "optimizer.sqp.max_iterations=10",
    "episodes={count: 20, unseen: 10}",
)  # fmt: skip
SETS = {"start": "before", "trained": "trained goals", "unseen": "unseen goals"}
RATIO, PART = 1.5, 0.25


class ArmReach(Figure):
    """The goals, and the distance of the tip from each in the end."""

    id = "cq1_arm_reach"
    title = "An arm reaches for goals that it has not seen"
    source = "CQ1, repository"
    paper = "a scene of CQ1's repository without a figure; no number is printed"
    notes = (
        "We chose to learn with sixty goals. With twenty goals, an arm of the paper's size came to 0.018 m from them "
        "in 60 iterations, but to 0.062 m from unseen ones. With sixty goals, a smaller arm came to 0.035 and 0.049 "
        "m. With two substeps a step instead of three, the first seed came to 0.043 and 0.061 m in 20 iterations, but "
        "blew up at an unseen goal. Three of the twenty unseen goals lie in corners of the range; they make up half "
        "of the mean error. There is one seed, because it takes about three hours"
    )
    criteria = {
        Size.QUICK: "the mean error over unseen goals is smaller than at the start",
        Size.PAPER: f"the mean error over 20 unseen goals is at most {RATIO:g} times the one over trained goals, and "
        f"at most {100 * PART:.0f} % of the one at the start",
    }

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return the seeds."""
        if size is Size.QUICK:
            return [Runs("arm_reach_3d", 2.5, "control", "control/arm_reach_3d", QUICK, 1)]
        return [Runs("arm_reach_3d", 240.0, "control", "control/arm_reach_3d", SINGLE, 1)]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return set, seed, x and z of the goal [m], error [m]."""
        return table_of(row for run in runs_below(folders["arm_reach_3d"]) for row in _rows(run))

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw the goals from above with their errors, and all errors side by side."""
        picture = new_figure(9.4, 3.6)
        above, side = picture.subplots(1, 2)
        for colour, (name, label) in zip((GREY, *COLOURS), SETS.items(), strict=False):
            rows = table["set"] == name
            if not rows.any():
                continue
            error = table["error"][rows]
            if name != "start":
                above.scatter(table["x"][rows], table["z"][rows], s=2000 * error, alpha=0.5, color=colour, label=label)
            place = list(SETS).index(name)
            spread = np.linspace(-0.25, 0.25, len(error)) if len(error) > 1 else [0.0]
            side.plot(place + np.asarray(spread), error, ".", color=colour, ms=5)
            side.plot([place - 0.3, place + 0.3], [np.nanmean(error)] * 2, color=colour, lw=2)
        above.set_xlabel("x of the goal [m]")
        above.set_ylabel("z of the goal [m]")
        above.set_aspect("equal", adjustable="datalim")
        sets = above.legend(title="area: error", loc="center left", bbox_to_anchor=(1.0, 0.5))
        for handle in sets.legend_handles:
            handle.set_sizes([40.0])
        side.set_xticks(range(len(SETS)), SETS.values())
        side.set_ylabel("tip to goal at the end [m]")
        side.set_ylim(bottom=0.0)
        titled(above, self.title)
        titled(side, "every goal, and the mean")
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the means over all seeds."""
        before, trained, unseen = (float(np.nanmean(table["error"][table["set"] == name])) for name in SETS)
        lost = np.isnan(table["error"])
        stable = {f"{lost.sum()} of {len(lost)} motions blew up": not lost.any()}
        if size is Size.QUICK:
            return Verdict.of(stable | {f"unseen goals {unseen:.3f} m, at the start {before:.3f}": unseen < before})
        return Verdict.of(stable | {
            f"unseen {unseen:.3f} m, trained {trained:.3f}: {unseen / trained:.2f} times": unseen <= RATIO * trained,
            f"{100 * unseen / before:.0f} % of the {before:.3f} m at the start": unseen <= PART * before,
        })  # fmt: skip


def _rows(run: Run) -> Iterator[dict[str, object]]:
    result = read_result(run.path)
    if not isinstance(result, LearnedResult):
        return
    for name in result.stages() | result.blew_up:
        stage = result.stages().get(name)
        for episode in stage.episodes if stage else []:
            x, _, z = episode.goals["target"]
            yield {"set": name, "seed": run.seed, "x": x, "z": z, "error": float(np.sqrt(episode.terms["tip"]))}
        for lost in result.blew_up.get(name, []):
            x, _, z = lost.goals["target"]
            yield {"set": name, "seed": run.seed, "x": x, "z": z, "error": np.nan}

"""CQ2's video: Neo-Hookean against fixed corotated on an oscillating, nearly incompressible actuator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.histories import observables
from benchmarks.papers.figure import Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.runs import Runs
from benchmarks.papers.machinery.task import Task
from cqrun.build.particles import sample
from cqrun.figures.run_data import read_run
from cqrun.figures.style import COLOURS, new_figure, titled

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

LAWS = {"neo_hookean": "neo-Hookean", "fixed_corotated": "fixed corotated"}
PATH = "bodies.bar.material.elastic"


class Oscillator(Figure):
    """The tip's path and the least volume ratio for both laws."""

    id = "cq2_oscillator"
    title = "Two elastic laws on a nearly incompressible actuator"
    source = "CQ2, video"
    paper = (
        "neo-Hookean and fixed corotated side by side on an oscillating, nearly incompressible actuator (no numbers)"
    )
    criteria = {
        size: "no particle is inverted with either law; the most compressed particle keeps more of its volume with "
        "neo-Hookean"
        for size in Size
    }
    notes = "The body, its muscles, nu = 0.48 and the rhythm are ours"

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return a run for each law, the same at both sizes."""
        parameters = "{youngs_modulus: 10, poissons_ratio: 0.48}"
        return [
            Runs(f"oscillator_{law}", 0.1, "simulate", "simulate/oscillator", (f"{PATH}={{{law}: {parameters}}}",))
            for law in LAWS
        ]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return law, time [s], tip_x and tip_y [m], least_volume_ratio."""
        rows: list[dict[str, object]] = []
        for name, folder in folders.items():
            law = name.removeprefix("oscillator_")
            (path,) = (file.parent for file in folder.rglob("trajectory.h5"))
            run, seen = read_run(path), observables(folder)
            trajectory = run.trajectory()
            tip = trajectory.fields["x"][:, sample(run.scene).groups("bar")["tip"]].mean(axis=1)
            least = np.interp(trajectory.time, seen["time"], seen["bar.least_volume_ratio"])
            rows += (
                {"law": law, "time": float(t), "tip_x": float(x), "tip_y": float(y), "least_volume_ratio": float(J)}
                for t, (x, y), J in zip(trajectory.time, tip, least, strict=True)
            )
        return table_of(iter(rows))

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw the tip's path and the least volume ratio."""
        picture = new_figure(8.0, 3.2)
        left, right = picture.subplots(1, 2)
        for colour, (law, label) in zip(COLOURS, LAWS.items(), strict=False):
            rows = table["law"] == law
            left.plot(table["time"][rows], table["tip_x"][rows], color=colour, label=label)
            right.plot(table["time"][rows], table["least_volume_ratio"][rows], color=colour)
        left.set_ylabel("x of the tip [m]")
        right.set_ylabel("least volume ratio of a particle")
        for axes in (left, right):
            axes.set_xlabel("time [s]")
        left.legend()
        titled(left, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the least volume ratios."""
        durations = {law: float(table["time"][table["law"] == law].max(initial=0.0)) for law in LAWS}
        if min(durations.values()) < max(durations.values()):
            return Verdict.of({f"both motions have the same duration: {durations}": False})
        least = {law: float(table["least_volume_ratio"][table["law"] == law].min()) for law in LAWS}
        neo, corotated = least["neo_hookean"], least["fixed_corotated"]
        tips = [table["tip_x"][table["law"] == law] for law in LAWS]
        apart = float(np.abs(tips[0] - tips[1]).max() / np.ptp(tips[0]))
        return Verdict.of({
            f"no particle is inverted; the tips are {100 * apart:.1f} % of the swing apart": min(least.values()) > 0,
            f"least volume ratio {neo:.3f} (neo-Hookean), {corotated:.3f} (fixed corotated)": neo > corotated,
        })  # fmt: skip

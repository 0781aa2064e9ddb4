"""CQ2, Appendix D: how long an iteration of each robot takes."""

from __future__ import annotations

import math
import os
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.distances import SINGLE
from benchmarks.papers.figure import Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.measurement import Measurement, Row, measure_rows, read_rows
from benchmarks.papers.machinery.process import STOPPED, run_command
from benchmarks.papers.machinery.runs import SCENES
from benchmarks.papers.machinery.task import Task, TaskError
from cqrun.build.model import build
from cqrun.figures.style import COLOURS, INK, log_ticks, new_figure, titled
from cqrun.plugin.contract import Array
from cqrun.scene.load import load_scene
from cqrun.store.history import read_history

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

ITERATIONS = 3
PRINTED = {
    "control/biped_cable": 12.0, "control/rhino": 21.0, "control/biped_terrain": 20.0, "control/creature": 38.0,
    "codesign/biped_codesign": 5.9, "codesign/quadruped_codesign": 6.2, "codesign/hexapod_codesign": 8.8,
    "codesign/octopod_codesign": 11.3,
}  # fmt: skip
"""Seconds an iteration on a GTX 1080: wall time on the upper axes of the figures, over iterations."""

SMALL = {
    "control/biped_cable": ("bodies.biped.spacing=0.00625", "time.duration=1"),
    "codesign/biped_codesign": ("bodies.biped.sampling.lattice.count=15", "time.duration=1"),
}
"""The scenes at quick size, and their overrides."""


class Seconds(Figure):
    """Seconds an iteration on all cores beside the printed ones."""

    id = "cq2_seconds"
    title = "How long an iteration takes"
    source = "CQ2, Appendix D"
    paper = "on a GTX 1080 " + ", ".join(f"{name.rpartition('/')[2]} {s:g} s" for name, s in PRINTED.items())
    criteria = {
        Size.QUICK: "the two robots in 2D have the paper's order. Their times are extrapolated: the time a particle "
        "and substep, times the particles and substeps of the paper's size",
        Size.PAPER: "on two cores in float32, no robot is slower than on the paper's GPU",
    }
    notes = (
        "The printed seconds are wall time over iterations, read off the figures' upper axes. Seconds extrapolated "
        "from quick size are up to one half above those at paper size, so only their order is judged (decided after "
        "the runs). Ours depend on the machine and the day. These are of a machine with AVX2, which on a slow day "
        "took 4.85, 15.4, 76.7, 46.2, 2.93, 11.5, 15.8 and 19.0 s. A machine with AVX-512 took 1.8, 6.7, 47, 24, 1.2, "
        "5.9, 9.3 and 10.3 s, the last four with finer cells than today (1/64 for the biped, 1/30 for the others). "
        "benchmarks/measured/profiles shows where the time of the last three goes, pass by pass, on the machine of "
        "this table (cqrun bench SCENE -o precision=float32 -o memory=8GiB --threads 2 --output FILE). Most of a "
        "gradient is spent in the two passes that gather from nodes, one of which evaluates the material law, and in "
        "the two that scatter to them. Of the hills' 20,000 substeps, a share of 0.8 is run twice, because their "
        "states do not fit into memory"
    )

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return the measurement."""
        minutes, measure = 1.3 if size is Size.QUICK else 19.0, partial(_measure, size)
        scenes = tuple(SCENES / f"{name}.yaml" for name in PRINTED)
        settings = (*SINGLE, f"{ITERATIONS} iterations", *((repr(SMALL),) if size is Size.QUICK else ()))
        return [Measurement("seconds", minutes, measure, self.command(size), scenes, settings, exclusive=True)]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return robot, particles, substeps, seconds, printed [s], ns a particle and substep, memory [GB], load.

        `steps` is the number of particles times substeps at paper size.
        """
        return table_of(read_rows(folders["seconds"]))

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw our seconds as bars, and the printed ones as diamonds."""
        picture = new_figure(7.2, 3.6)
        axes = picture.add_subplot()
        at = np.arange(len(table["robot"]))
        ours = table["seconds"] if size is Size.PAPER else _extrapolated(table)
        how = "" if size is Size.PAPER else ", extrapolated to the paper's size"
        axes.bar(at, ours, 0.6, color=COLOURS[0], label=f"cqrun, two cores, float32{how}")
        axes.plot(at, table["printed"], "D", color=INK, mec="white", ms=7, label="paper, GTX 1080")
        axes.set_xticks(at, [str(robot).replace("_", "\n") for robot in table["robot"]], fontsize=8)
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5 * min(ours))
        foot = axes.get_ylim()[0]
        for x, seconds in zip(at, ours, strict=True):  # at the foot, where no diamond covers them
            axes.annotate(f"{seconds:.3g}", (x, foot), (0, 3), textcoords="offset points", ha="center", color="white")
        log_ticks(axes.yaxis, *axes.get_ylim())
        axes.set_ylabel("seconds an iteration")
        axes.legend()
        titled(axes, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge every robot; at quick size, only which of the two takes longer."""
        if size is Size.QUICK:
            ours, printed = _extrapolated(table), np.asarray(table["printed"])
            text = ", ".join(
                f"{robot} {seconds:.3g} s ({ns:.0f} ns a particle and substep), paper {paper:g}"
                for robot, seconds, ns, paper in zip(table["robot"], ours, table["ns"], printed, strict=True)
            )
            same = np.array_equal(np.argsort(ours), np.argsort(printed))
            return Verdict.of({f"the paper's order: {text}": len(ours) == len(SMALL) and same})
        rows = zip(table["robot"], table["seconds"], table["printed"], table["memory"], strict=True)
        return Verdict.of({
            f"{robot} {ours:.3g} s, paper {paper:g}; at most {memory:.2g} GB": ours <= paper
            for robot, ours, paper, memory in rows
        })  # fmt: skip


def _extrapolated(table: Table) -> Array:
    """Return the seconds that the paper's numbers of particles and substeps would take."""
    return np.asarray(1e-9 * table["ns"] * table["steps"])


def _measure(size: Size, folder: Path, deadline: float) -> bool:
    """Time an iteration of each robot; return whether all are timed."""
    rows = {
        str(k): partial(_row, scene, SMALL.get(scene, ()) if size is Size.QUICK else (), folder, deadline)
        for k, scene in enumerate(PRINTED)
        if size is Size.PAPER or scene in SMALL
    }
    return measure_rows(folder, deadline, rows)


def _row(name: str, smaller: Sequence[str], folder: Path, deadline: float) -> Row | None:
    """Run a few iterations of a scene alone on all cores; return the median time, or None if the time is over."""
    path, overrides = SCENES / f"{name}.yaml", (*SINGLE, *smaller)
    scene = load_scene(path, list(overrides))
    assert scene.optimizer is not None
    assert scene.job is not None
    words = [*overrides, f"optimizer.{scene.optimizer.name}.max_iterations={ITERATIONS}"]
    out = folder / path.stem
    command = [sys.executable, "-m", "cqrun", scene.job, str(path), "--quiet", "--fresh", "--out", str(out)]
    command += [word for override in words for word in ("-o", override)]
    load = os.getloadavg()[0]
    ended = run_command(path.stem, command, deadline)
    if ended.status == STOPPED:
        return None
    if ended.status:
        raise TaskError(f"{shlex.join(command)} ended with {ended.status}\n{ended.output}")
    (history,) = out.rglob("history.csv")
    seconds = float(np.median(np.diff(read_history(history)["seconds"])))
    particles, substeps = _counts(name, overrides)
    return {
        "robot": path.stem, "printed": PRINTED[name], "steps": math.prod(_counts(name, SINGLE)),
        "particles": particles, "substeps": substeps, "seconds": seconds,
        "ns": seconds / (particles * substeps) * 1e9, "memory": ended.memory, "load": load,
    }  # fmt: skip


def _counts(name: str, overrides: Sequence[str]) -> tuple[int, int]:
    """Return how many particles and substeps a scene has."""
    model = build(load_scene(SCENES / f"{name}.yaml", list(overrides))).model
    return model.layout.n_particles, model.n_steps

"""CQ2, Appendix D: how long an iteration of each robot takes."""

from __future__ import annotations

import csv
import json
import math
import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.families.distances import SINGLE
from benchmarks.papers.figure import Figure, Size, Table, Verdict, judged, stacked
from benchmarks.papers.machinery.measurement import Measurement
from benchmarks.papers.machinery.process import STOPPED, with_memory
from benchmarks.papers.machinery.work import SCENES, Found, Work, WorkError
from cqrun.build.model import build
from cqrun.figures.style import COLOURS, INK, log_ticks, new_figure, titled
from cqrun.plugin.contract import Array
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

ITERATIONS = 3
PRINTED = {
    "control/biped_cable": 12.0, "control/rhino": 21.0, "control/biped_terrain": 20.0, "control/creature": 38.0,
    "codesign/biped_codesign": 5.9, "codesign/quadruped_codesign": 6.2, "codesign/hexapod_codesign": 8.8,
    "codesign/octopod_codesign": 11.3,
}  # fmt: skip
"""Seconds an iteration on a GTX 1080: wall time on the figures' upper axes over iterations."""

SOURCES = tuple(SCENES / f"{name}.yaml" for name in PRINTED)

SMALL = {
    "control/biped_cable": ("bodies.biped.spacing=0.00625", "time.duration=1"),
    "codesign/biped_codesign": ("bodies.biped.sampling.lattice.count=15", "time.duration=1"),
}
"""What is timed at quick size, and its overrides."""


class Seconds(Figure):
    """Seconds an iteration on all cores beside the printed ones."""

    id = "cq2_seconds"
    title = "How long an iteration takes"
    source = "CQ2, Appendix D"
    paper = "on a GTX 1080 " + ", ".join(f"{name.rpartition('/')[2]} {s:g} s" for name, s in PRINTED.items())
    tolerance = {
        Size.QUICK: "of the two robots in 2D, that one takes longer which does in the paper: what a particle and "
        "substep takes, times as many as the paper's size has",
        Size.PAPER: "on two cores in float32, no slower than the paper's GPU",
    }
    left_open = (
        "seconds are wall time over iterations, read off the figures' upper axes. Those extrapolated from quick size "
        "are up to half above those at the paper's, and only their order is judged (settled after the runs). Ours "
        "depend on the host and its day: these are of one with AVX2, which on a slow day took 4.85, 15.4, 76.7, 46.2, "
        "2.93, 11.5, 15.8 and 19.0 s. One with AVX-512 took 1.8, 6.7, 47, 24, 1.2, 5.9, 9.3 and 10.3 s, the last four "
        "with finer cells than they have now (1/64 the biped's, 1/30 the others'). benchmarks/measured/profiles says "
        "what takes the time of the last three, pass by pass, on the host of this table (cqrun bench SCENE -o "
        "precision=float32 -o memory=8GiB --threads 2 --output FILE): most of a gradient is the two passes that "
        "gather from nodes, with the material law in the one, and the two that scatter to them. Of the hills' 20,000 "
        "substeps, .8 are run twice, for their states do not fit"
    )

    def work(self, size: Size) -> Sequence[Work]:
        """Return the measurement."""
        told = f"python -m benchmarks.papers --size {size} --only {self.id}"
        minutes = 1.3 if size is Size.QUICK else 19.0
        return [
            Measurement(
                "seconds",
                minutes,
                lambda folder, end: _measure(folder, end, size),
                told,
                SOURCES,
                (*SINGLE, f"{ITERATIONS} iterations", *((repr(SMALL),) if size is Size.QUICK else ())),
                alone=True,
            )
        ]

    def table(self, found: Found, size: Size) -> Table:
        """Return robot, particles, substeps, seconds, printed [s], ns a particle and substep, memory [GB], load.

        `steps` is what the paper's size has of particles times substeps.
        """
        files = sorted(found["seconds"].glob("row-*.json"))
        return stacked(json.loads(file.read_text()) for file in files)

    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Draw ours as bars and the printed ones as diamonds."""
        picture = new_figure(7.2, 3.6)
        axes = picture.add_subplot()
        at = np.arange(len(table["robot"]))
        ours = table["seconds"] if size is Size.PAPER else _whole(table)
        told = "" if size is Size.PAPER else ", extrapolated to the paper's size"
        axes.bar(at, ours, 0.6, color=COLOURS[0], label=f"cqrun, two cores, float32{told}")
        axes.plot(at, table["printed"], "D", color=INK, mec="white", ms=7, label="paper, GTX 1080")
        axes.set_xticks(at, [str(robot).replace("_", "\n") for robot in table["robot"]], fontsize=8)
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5 * min(ours))
        foot = axes.get_ylim()[0]
        for x, seconds in zip(at, ours, strict=True):  # where no diamond covers them
            axes.annotate(f"{seconds:.3g}", (x, foot), (0, 3), textcoords="offset points", ha="center", color="white")
        log_ticks(axes.yaxis, *axes.get_ylim())
        axes.set_ylabel("seconds an iteration")
        axes.legend()
        titled(axes, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge every robot, at quick size which takes longer."""
        if size is Size.QUICK:
            whole, printed = _whole(table), np.asarray(table["printed"])
            told = ", ".join(
                f"{robot} {seconds:.3g} s ({ns:.0f} ns a particle and substep), paper {theirs:g}"
                for robot, seconds, ns, theirs in zip(table["robot"], whole, table["ns"], printed, strict=True)
            )
            same = np.array_equal(np.argsort(whole), np.argsort(printed))
            return judged({f"the order of the paper: {told}": len(whole) == len(SMALL) and same})
        rows = zip(table["robot"], table["seconds"], table["printed"], table["memory"], strict=True)
        return judged({
            f"{robot} {ours:.3g} s, paper {theirs:g}; {memory:.2g} GB at most": ours <= theirs
            for robot, ours, theirs, memory in rows
        })  # fmt: skip


def _whole(table: Table) -> Array:
    """Return the seconds that the paper's numbers of particles and substeps would take."""
    return np.asarray(1e-9 * table["ns"] * table["steps"])


def _measure(folder: Path, deadline: float, size: Size) -> bool:
    """Time what is missing, a file each; say whether all is there."""
    for k, (scene, printed) in enumerate(PRINTED.items()):
        file = folder / f"row-{k}.json"
        if file.exists() or (size is Size.QUICK and scene not in SMALL):
            continue
        if time.monotonic() > deadline:
            return False
        overrides = (*SINGLE, *(SMALL[scene] if size is Size.QUICK else ()))
        steps = math.prod(_counts(scene, SINGLE))
        timed = _timed(scene, overrides, folder, deadline)
        if timed is None:
            return False
        write_json(file, {"robot": scene.rpartition("/")[2], "printed": printed, "steps": steps} | timed)
    return True


def _timed(name: str, overrides: Sequence[str], folder: Path, deadline: float) -> dict[str, object] | None:
    """Run a few iterations of a scene alone on all cores; return what they took, the median, or None out of time."""
    path = SCENES / f"{name}.yaml"
    scene = load_scene(path, list(overrides))
    assert scene.optimizer is not None
    words = [*overrides, f"optimizer.{scene.optimizer.name}.max_iterations={ITERATIONS}"]
    out = folder / path.stem
    assert scene.job is not None
    command = [sys.executable, "-m", "cqrun", scene.job, str(path), "--quiet", "--fresh", "--out", str(out)]
    command += [word for override in words for word in ("-o", override)]
    load = os.getloadavg()[0]
    code, said, memory = with_memory(path.stem, command, deadline)
    if code == STOPPED:
        return None
    if code:
        raise WorkError(f"{shlex.join(command)} ended with {code}\n{said}")
    (history,) = out.rglob("history.csv")
    with history.open(newline="") as lines:
        seconds = float(np.median(np.diff([float(row["seconds"]) for row in csv.DictReader(lines)])))
    particles, substeps = _counts(name, overrides)
    return {
        "particles": particles, "substeps": substeps, "seconds": seconds,
        "ns": seconds / (particles * substeps) * 1e9, "memory": memory, "load": load,
    }  # fmt: skip


def _counts(name: str, overrides: Sequence[str]) -> tuple[int, int]:
    """Return how many particles and substeps a scene has."""
    model = build(load_scene(SCENES / f"{name}.yaml", list(overrides))).model
    return model.layout.n_particles, model.n_steps

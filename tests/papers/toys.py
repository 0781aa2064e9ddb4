"""A figure and tasks that take no time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.papers.figure import Figure, Size, Verdict, table_of
from benchmarks.papers.machinery.measurement import Measurement
from benchmarks.papers.machinery.runs import Runs
from cqrun.figures.style import new_figure

TEAR = Runs("tear", 0.1, "simulate", "simulate/tear", ("time.duration=0.04", "time.substeps=8"))


class Toy(Figure):
    """Three numbers, one after the other."""

    id, title, source, paper = "toy", "three numbers", "nowhere", "1 2 3"
    criteria = dict.fromkeys(Size, "they grow")

    def __init__(self, *tasks):
        self.all_tasks = tasks

    def tasks(self, size):
        return self.all_tasks

    def table(self, folders, size):
        files = sorted(file for folder in folders.values() for file in folder.glob("*.txt"))
        return table_of({"k": float(file.stem), "label": file.read_text()} for file in files)

    def draw(self, table, size, folders):
        picture = new_figure(2.0, 2.0)
        picture.add_subplot().plot(table["k"])
        return picture

    def judge(self, table, size):
        return Verdict.of({"they grow": bool(np.all(np.diff(table["k"]) > 0)), "there are three": len(table["k"]) == 3})


def counting(folder: Path, deadline: float) -> bool:
    """Write the next of three files; return whether all are there."""
    k = len(list(folder.glob("*.txt")))
    (folder / f"{k}.txt").write_text("odd" if k % 2 else "even")
    return k == 2


COUNT = Measurement("count", 1.0, counting, "count to three")

"""CQ1 Table II: how long a frame of a falling block takes, forward and backward."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.papers.figure import Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.measurement import Measurement, Row, measure_rows, read_rows
from benchmarks.papers.machinery.task import Task
from cqrun.figures.style import COLOURS, GREY, TRUTH, new_figure, titled
from cqrun.jobs import bench
from cqrun.jobs.bench import REPEAT

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

FRAME = 3
"""Substeps of CQ1's frame."""

PRINTED = {
    ("2D", 6400): {"CUDA": (0.10, 0.14), "TensorFlow": (13.2, 35.7)},
    ("3D", 8000): {"CUDA": (0.392, 0.406), "Flex (8,024)": (3.5, np.nan)},
    ("3D", 64000): {"CUDA": (1.594, 1.774), "Flex (61,238)": (6.0, np.nan)},
    ("3D", 512000): {"CUDA": (10.501, 11.594)},
}
"""(dimension, particles) -> implementation on a GTX 1080 Ti -> ms a frame, forward and backward."""

SIZES = {Size.QUICK: bench.SIZES[:3], Size.PAPER: bench.SIZES[:4]}
"""Dimension and particles along an edge of each block."""


class Speed(Figure):
    """Milliseconds a frame beside the printed ones."""

    id = "cq1_table2"
    title = "How long a frame takes"
    source = "CQ1 Table II"
    paper = (
        "3D forward and backward: 0.39 and 0.41 ms with 8,000 particles, 1.6 and 1.8 ms with 64,000, 10.5 and 11.6 ms "
        "with 512,000. 2D with 6,400 particles: 0.10 and 0.14 ms, TensorFlow 13.2 and 35.7 ms. Flex: 3.5 ms with "
        "8,024 particles and 6 ms with 61,238. All on a GTX 1080 Ti. The text says 4 to 9 times as fast as Flex, and "
        "132 times as fast as TensorFlow"
    )
    criteria = {
        Size.QUICK: "64,000 particles cost at most 1.5 times as much for each particle as 8,000 do, forward and "
        "backward; how long a frame takes is judged at paper size",
        Size.PAPER: "two cores are faster than TensorFlow (2D) and Flex (3D, forward) on the GPU; CUDA is not judged",
    }
    notes = (
        "CQ1's CUDA code ran on a GPU with 11 TFLOP/s. Two cores are not asked to be as fast, and they are not: CUDA "
        "is 3 to 22 times as fast as they are in float64, most of all backward with 512,000 particles. Flex, which "
        "moves points and has no gradient, takes 6 ms for 61,238 particles; two cores take 9.8 ms for 64,000 in "
        "float64, and 6.2 ms in float32. Decision 001 says what made the passes faster, and what did not help"
    )

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return the measurement; at quick size without 512,000 particles."""
        minutes, settings = (
            3.5 if size is Size.QUICK else 4.0,
            (repr(SIZES[size]), f"{REPEAT} turns, {bench.SUBSTEPS} substeps"),
        )
        measure = partial(_measure, SIZES[size])
        return [Measurement("speed", minutes, measure, self.command(size), (), settings, exclusive=True)]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return case, particles, implementation, precision, threads, forward and backward [ms a frame], load."""
        rows = read_rows(folders["speed"])
        for (case, particles), others in PRINTED.items():
            for name, (forward, backward) in others.items():
                rows.append({
                    "case": case, "particles": particles, "implementation": name, "precision": "float32",
                    "forward": forward, "backward": backward,
                })  # fmt: skip
        return table_of(rows)

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw a bar for each implementation, size and pass, on a logarithmic axis."""
        cases = [case for case in PRINTED if np.any(_rows_of(table, case, "cqrun"))]
        picture = new_figure(9.0, 3.6)
        for axes, way in zip(picture.subplots(1, 2, sharey=True), ("forward", "backward"), strict=True):
            for k, case in enumerate(cases):
                bars = _bars(table, case, way)
                for j, (label, value, colour) in enumerate(bars):
                    place = k + (j - (len(bars) - 1) / 2) * 0.15
                    axes.bar(place, value, 0.14, color=colour, label=label)
            axes.set_xticks(range(len(cases)), [f"{case}\n{particles:,}" for case, particles in cases])
            axes.set_yscale("log")
            titled(axes, way)
        picture.axes[0].set_ylabel("ms a frame of 3 substeps")
        handles = {label: handle for axes in picture.axes for handle, label in zip(
            *axes.get_legend_handles_labels(), strict=True)}  # fmt: skip
        picture.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge two cores beside TensorFlow and Flex; at quick size, how the cost grows with the particles."""
        checks: dict[str, bool] = {}
        if size is Size.QUICK:
            for way in ("forward", "backward"):
                few, many = (_best(table, ("3D", n), way) / n for n in (8000, 64000))
                text = f"3D {way}: 64,000 particles cost {many / few:.2f} times as much for each particle"
                checks[text] = many < 1.5 * few
            return Verdict.of(checks)
        for case, name, ways in (
            (("2D", 6400), "TensorFlow", ("forward", "backward")), (("3D", 8000), "Flex (8,024)", ("forward",)),
            (("3D", 64000), "Flex (61,238)", ("forward",)),
        ):  # fmt: skip
            for way in ways:
                ours, theirs = _best(table, case, way), float(table[way][_rows_of(table, case, name)][0])
                checks[f"{case[0]} {case[1]:,} {way} {ours:.3g} ms, {name} {theirs:g}"] = ours < theirs
        return Verdict.of(checks)


def _rows_of(table: Table, case: tuple[str, int], name: str) -> Any:
    """Return which rows are of an implementation in a case."""
    return (table["case"] == case[0]) & (table["particles"] == case[1]) & (table["implementation"] == name)


def _bars(table: Table, case: tuple[str, int], way: str) -> list[tuple[str, float, str]]:
    """Return label, milliseconds a frame and colour of each implementation in a case."""
    bars = []
    for (precision, threads), colour in zip((("float64", 1), ("float64", 2), ("float32", 2)), COLOURS, strict=False):
        rows = _rows_of(table, case, "cqrun") & (table["precision"] == precision) & (table["threads"] == threads)
        if rows.any():
            label = f"cqrun, {precision}, {threads} thread{'s'[: threads > 1]}"
            bars.append((label, table[way][rows][0], colour))
    for name, colour in (("CUDA", GREY), ("Flex", COLOURS[4]), ("TensorFlow", TRUTH)):
        named = np.char.startswith(np.asarray(table["implementation"], str), name)
        rows = (table["case"] == case[0]) & (table["particles"] == case[1]) & named
        if rows.any() and np.isfinite(table[way][rows][0]):  # Flex has no gradient
            bars.append((f"{name}, GTX 1080 Ti", table[way][rows][0], colour))
    return bars


def _best(table: Table, case: tuple[str, int], way: str) -> float:
    """Return our milliseconds a frame in float64, with the best number of threads."""
    ours = _rows_of(table, case, "cqrun") & (table["precision"] == "float64")
    return float(table[way][ours].min())


def _measure(sizes: Sequence[tuple[int, int]], folder: Path, deadline: float) -> bool:
    """Measure blocks of a dimension and a number of particles along an edge; return whether all are measured."""
    rows = {
        f"{dim}-{edge:03d}-{precision}-{threads}": partial(_row, dim, edge, precision, threads)
        for dim, edge in sizes
        for precision in ("float64", "float32")
        for threads in (1, 2)
    }
    return measure_rows(folder, deadline, rows)


def _row(dim: int, edge: int, precision: str, threads: int) -> Row:
    block = bench.excerpt_of_block(dim, edge, np.dtype(precision).type, threads)
    ns = block.measure(REPEAT)
    frame = FRAME * block.n * 1e-6  # ns a particle and substep -> ms a frame
    return {
        "case": f"{dim}D", "particles": block.n, "implementation": "cqrun", "precision": precision,
        "threads": block.rollout.threads, "forward": frame * ns["forward"],
        "backward": frame * ns["backward"], "load": os.getloadavg()[0],
    }  # fmt: skip

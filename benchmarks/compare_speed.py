"""Compare the speed of two checkouts, pass by pass, in turns: is any pass slower?

    python benchmarks/compare_speed.py BEFORE AFTER [--turns 10] [--threads 1] [--scene FILE ...] [--out FILE.json]

BEFORE and AFTER are folders with a checkout and its environment in `.venv`. In each turn, a new process of each
checkout measures the same substeps of a block, or of a scene. New processes average over where arrays lie in memory.
The numbers are medians over turns, in ns per particle and substep. There are two ratios: the median of the ratios of
each turn, and the ratio of the shortest times. The second is the better one on a machine that others share, because
they only make a turn longer. A pass is called from Python here, which takes some microseconds: read the passes of
large blocks. With two threads, a process needs about ten rollouts until each thread has a core of its own, so REPEAT
must be larger.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

BLOCKS = ((2, 80), (3, 20), (2, 320), (3, 40))
"""Dimension and edge, in particles, of the falling blocks of `cqrun bench` that are compared."""

REPEAT = 3
"""How often a process repeats each measurement."""


def measured(checkout: Path, cases: list[Any], threads: int) -> list[dict[str, float]]:
    """Return ns per particle and substep of the whole and of each pass, for each case, from a new process."""
    python = checkout / ".venv" / "bin" / "python"
    command = [str(python), str(Path(__file__).resolve()), "--worker", json.dumps([cases, threads])]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, cwd=checkout, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return [dict(found) for found in json.loads(done.stdout)]


def work(cases: list[Any], threads: int) -> None:
    """Measure the cases, and print what was measured."""
    bench, scenes = _first("cqrun.jobs.bench"), _first("cqrun.jobs.bench_scene", "cqrun.jobs.bench")
    results = [_excerpt(bench, scenes, case, threads).measure(REPEAT) for case in cases]
    print(json.dumps([{name: r[name] for name in ("forward", "store", "backward")} | r["passes"] for r in results]))


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        return None


def _excerpt(bench: Any, scenes: Any, case: Any, threads: int) -> Any:
    if not isinstance(case, str):
        return bench.excerpt_of_block(*case, np.float64, threads)
    model = _first("cqrun.build.model", "cqrun.scene.build")
    talk = _first("cqrun.running.reporter", "cqrun.jobs.reporter").Silent()
    scene = importlib.import_module("cqrun.scene.load").load_scene(Path(case), ())
    return scenes.excerpt_of(model.build(scene), threads, talk)


def _first(*names: str) -> Any:
    """Import the first of these modules that the checkout has."""
    return next(module for name in names if (module := _imported(name)) is not None)


def main() -> None:
    """Print a table for each block and scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, nargs="?")
    parser.add_argument("after", type=Path, nargs="?")
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--scene", nargs="*", default=[])
    parser.add_argument("--no-blocks", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(*json.loads(options.worker))
        return
    cases: list[Any] = [] if options.no_blocks else [list(block) for block in BLOCKS]
    cases += options.scene
    folders = [folder.resolve() for folder in (options.before, options.after)]
    for folder in folders:  # the first run compiles
        measured(folder, cases, options.threads)
    turns = [[measured(folder, cases, options.threads) for folder in folders] for _ in range(options.turns)]
    result = {}
    for k, case in enumerate(cases):
        name = case if isinstance(case, str) else f"block {case[0]}D, {case[1] ** case[0]:,} particles"
        result[name] = compared([[side[k] for side in turn] for turn in turns])
        print(name, *table(result[name]), sep="\n", flush=True)
    print(f"load {os.getloadavg()[0]:.2f}")
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


def compared(turns: list[list[dict[str, float]]]) -> dict[str, dict[str, float | None]]:
    """Return medians and ratios of what both checkouts measure, and the medians of what one of them has alone."""
    found: dict[str, dict[str, float | None]] = {}
    for name in dict.fromkeys(name for pair in turns for measured in pair for name in measured):
        before, after = ([m[name] for m in side if name in m] for side in zip(*turns, strict=True))
        ratio = float(np.median(np.array(after) / np.array(before))) if before and after else None
        medians = (float(np.median(side)) if side else None for side in (before, after))
        shortest = min(after) / min(before) if before and after else None
        found[name] = dict(zip(("before", "after"), medians, strict=True)) | {"ratio": ratio, "shortest": shortest}
    return found


def table(found: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    """Return the lines of a table."""

    def shown(value: float | None) -> str:
        return "-" if value is None else f"{value:.3g}"

    columns = ("before", "after", "ratio", "shortest")
    rows = (f"  {name:18s}" + "".join(f"{shown(row[c]):>9s}" for c in columns) for name, row in found.items())
    return ["  " + " " * 18 + "".join(f"{c:>9s}" for c in columns), *rows]


if __name__ == "__main__":
    main()

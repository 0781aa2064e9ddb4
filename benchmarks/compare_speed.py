"""Compare the speed of two checkouts, pass by pass, in turns: is any pass slower?

    python benchmarks/compare_speed.py BEFORE AFTER [--turns 20] [--threads 1] [--scene FILE ...] [--out FILE.json]

BEFORE and AFTER are folders with a checkout and its environment in `.venv`. Each has a worker process that holds the
same substeps of a block, or of a scene, and measures them when it is its turn, so that both see the same noise of the
machine. The numbers are medians over turns, in ns per particle and substep; the ratio is the median of the ratios of
each turn. Many short turns are better than a few long ones, because noise of a machine lasts for seconds. Measure on a
machine that does nothing else: the load is printed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

BLOCKS = ((2, 80), (3, 20), (2, 320), (3, 40))
"""Dimension and edge, in particles, of the falling blocks of `cqrun bench` that are compared."""


class Worker:
    """A process in a checkout that measures when it is asked."""

    def __init__(self, checkout: Path, cases: list[Any], threads: int) -> None:
        python = checkout / ".venv" / "bin" / "python"
        command = [str(python), str(Path(__file__).resolve()), "--worker", json.dumps([cases, threads])]
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        self.process = subprocess.Popen(
            command, cwd=checkout, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def measure(self, case: int) -> dict[str, float]:
        """Return ns per particle and substep of the whole and of each pass."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{case}\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"the worker ended with {self.process.wait()}")
        return dict(json.loads(line))


def work(cases: list[Any], threads: int) -> None:
    """Measure the cases that standard input names, one a line."""
    bench, scenes = _first("cqrun.jobs.bench"), _first("cqrun.jobs.bench_scene", "cqrun.jobs.bench")
    excerpts: dict[int, Any] = {}
    for line in sys.stdin:
        k = int(line)
        if k not in excerpts:
            excerpts[k] = _excerpt(bench, scenes, cases[k], threads)
        found = excerpts[k].measure(2)
        whole = {name: found[name] for name in ("forward", "store", "backward")}
        print(json.dumps(whole | found["passes"]), flush=True)


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
    parser.add_argument("--turns", type=int, default=20)
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
    workers = [Worker(folder.resolve(), cases, options.threads) for folder in (options.before, options.after)]
    result = {}
    for k, case in enumerate(cases):
        for worker in workers:  # the first run compiles
            worker.measure(k)
        turns = [[worker.measure(k) for worker in workers] for _ in range(options.turns)]
        name = case if isinstance(case, str) else f"block {case[0]}D, {case[1] ** case[0]:,} particles"
        result[name] = compared(turns)
        print(f"{name} (load {os.getloadavg()[0]:.2f})", *table(result[name]), sep="\n", flush=True)
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


def compared(turns: list[list[dict[str, float]]]) -> dict[str, dict[str, float | None]]:
    """Return medians and ratios of what both checkouts measure, and the medians of what one of them has alone."""
    found: dict[str, dict[str, float | None]] = {}
    for name in dict.fromkeys(name for pair in turns for measured in pair for name in measured):
        before, after = ([m[name] for m in side if name in m] for side in zip(*turns, strict=True))
        ratio = float(np.median(np.array(after) / np.array(before))) if before and after else None
        medians = (float(np.median(side)) if side else None for side in (before, after))
        found[name] = dict(zip(("before", "after"), medians, strict=True)) | {"ratio": ratio}
    return found


def table(found: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    """Return the lines of a table."""

    def shown(value: float | None) -> str:
        return "-" if value is None else f"{value:.3g}"

    return [
        f"  {name:18s} {shown(row['before']):>8s} {shown(row['after']):>8s} {shown(row['ratio']):>8s}"
        for name, row in found.items()
    ]


if __name__ == "__main__":
    main()

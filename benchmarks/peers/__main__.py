"""python -m benchmarks.peers [--sizes 2d_6400 ...] [--repeat 7] [--core 0] [--output FILE]

Each installed implementation has a process of its own, all on the same core. They run in turns, and a time is the
median over the turns. All have to agree on the loss and on the norms of both gradients. A size that is measured again
replaces its entry in FILE; other sizes stay.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.problem import SIZES, SUBSTEPS
from benchmarks.peers.worker import NAMES, PRECISIONS
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.store.atomic import make_directory, write_json

PACKAGES = {"cqrun": "cqrun", "cqrun_float32": "cqrun", "warp": "warp", "taichi": "taichi", "jax": "jax"}
WANTED = {"2d": {"taichi": 8.0, "warp": 4.0, "jax": 15.0}, "3d": {"taichi": 10.0, "warp": 4.0, "jax": 15.0}}
"""How many times as fast as a peer cqrun has to be, forward and backward together."""

AGREE = 2e-4
"""Relative difference that is allowed in float32."""

ROOT = Path(__file__).parents[2]


class Worker:
    """A process that runs one implementation."""

    def __init__(self, name: str, size: str, core: int) -> None:
        words = [sys.executable, "-m", "benchmarks.peers.worker", name, size, str(core)]
        self.log = tempfile.TemporaryFile("w+")  # noqa: SIM115  (closed by `end`; shown only if the process fails)
        self.process = subprocess.Popen(
            words, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.log
        )
        self.first = self.read()["first"]

    def read(self) -> dict[str, Any]:
        """Return the next answer."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.communicate()
            with self.log:
                self.log.seek(0)
                tail = self.log.read()[-2000:]
            command = " ".join(self.process.args)  # type: ignore[arg-type]
            raise SystemExit(f"{command} ended with {self.process.returncode}\n{tail}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def ask(self, request: str) -> dict[str, Any]:
        """Send a request and return the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(request + "\n")
        self.process.stdin.flush()
        return self.read()

    def end(self) -> None:
        """End the process."""
        self.process.communicate()
        self.log.close()


def compare(size: str, names: Sequence[str], repeat: int, core: int) -> list[dict[str, Any]]:
    """Return a row for each implementation: ms a substep forward, backward and together, and its ratio to cqrun's."""
    workers = {name: Worker(name, size, core) for name in names}
    seconds: dict[str, dict[str, list[float]]] = {name: {"forward": [], "backward": []} for name in names}
    for _ in range(repeat):
        for name, worker in workers.items():
            for way, times in seconds[name].items():
                times.append(worker.ask(way)["seconds"])
    rows = []
    for name, worker in workers.items():
        results = worker.ask("results")
        worker.end()
        ways = {way: 1e3 * float(np.median(times)) / SUBSTEPS for way, times in seconds[name].items()}
        both = np.array(seconds[name]["backward"])
        if not results["backward_holds_forward"]:
            both = both + np.array(seconds[name]["forward"])
        rows.append({
            "size": size, "name": name, "precision": PRECISIONS.get(name, "float32"), **ways,
            "together": 1e3 * float(np.median(both)) / SUBSTEPS, "first_call_s": worker.first,
            **{key: results[key] for key in ("loss", "by_v", "by_E")}, "load": os.getloadavg()[0],
        })  # fmt: skip
    ours = next(row for row in rows if row["name"] == "cqrun")
    for row in rows:
        row["ratio"] = row["together"] / ours["together"]
        row["disagreement"] = max(abs(row[key] / ours[key] - 1.0) for key in ("loss", "by_v", "by_E"))
    return rows


def line(row: dict[str, Any]) -> str:
    """Return a row as a line of text."""
    wanted = WANTED[row["size"][:2]].get(row["name"])
    asked = f"  (asked {wanted:g})" if wanted else ""
    return (
        f"{row['size']:<10} {row['name']:<13} {row['precision']}  forward {row['forward']:8.3f}  backward "
        f"{row['backward']:8.3f}  together {row['together']:8.3f} ms  {row['ratio']:6.2f} times cqrun{asked}  "
        f"differs by {row['disagreement']:.0e}"
    )


def main() -> None:
    """Measure what is installed; print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--names", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "measured" / "peers.json")
    options = parser.parse_args()
    installed = [name for name in options.names if importlib.util.find_spec(PACKAGES[name]) is not None]
    if missing := [name for name in options.names if name not in installed]:
        print(f"not installed, and not measured: {', '.join(missing)} (pip install 'cqrun[peers]')")
    if set(installed) <= set(PRECISIONS):
        print("nothing to compare with: no peer is installed")
        return
    make_directory(options.output.parent)
    for size in options.sizes:
        rows = compare(size, [name for name in installed if name != "cqrun"] + ["cqrun"], options.repeat, options.core)
        for row in rows:
            print(line(row), flush=True)
            if row["disagreement"] > AGREE:
                raise SystemExit(f"{row['name']} and cqrun disagree by more than {AGREE:g}: {row}")
        measured = json.loads(options.output.read_text()) if options.output.exists() else {}
        write_json(options.output, measured | {size: {"engine": engine_hash(), "machine": machine(), "rows": rows}})


if __name__ == "__main__":
    main()

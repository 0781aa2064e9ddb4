"""Where does the first start of a kind of scene go? CPU seconds by stage, with an empty cache.

    python benchmarks/compile_time.py [CHECKOUT ...] [--scene FILE ...] [--forward] [--out FILE.json]

CHECKOUT is a folder with a checkout whose dependencies this Python has; this one, if none is given. Each scene of each
checkout gets a new process with an empty cache, one after the other. It builds the scene, then compiles its kernels
with their adjoints (or without: `--forward`). CPU seconds hardly depend on what else the machine does. A stage does
not count what happens inside it in another stage.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCENES = ("scenes/control/biped.yaml", "scenes/control/arm_reach_3d.yaml", "scenes/robots/gripper_tendon.yaml")

LLVM = {
    "_optimize_functions": "LLVM: each function", "add_ir_module": "LLVM: reading text",
    "_optimize_final_module": "LLVM: each module", "_finalize_final_module": "LLVM: machine code",
    "finalize": "LLVM: linking",
}  # fmt: skip
"""Method of a library of Numba's -> stage."""

PASSES = {"BaseTypeInference": "types", "BaseNativeLowering": "lowering"}
"""Numba's passes that take long -> stage; the others are `other passes`."""


class Stages:
    """CPU seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = collections.defaultdict(float)
        self.calls: dict[str, int] = collections.defaultdict(int)
        self.inside: list[float] = []

    def watch(self, owner: Any, name: str, stage: str) -> None:
        """Count a method of a class as part of a stage."""
        run: Callable[..., Any] = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            begin = time.thread_time()
            self.inside.append(0.0)
            try:
                return run(*arguments, **options)
            finally:
                seconds = time.thread_time() - begin
                self.seconds[stage] += seconds - self.inside.pop()
                self.calls[stage] += 1
                if self.inside:
                    self.inside[-1] += seconds

        setattr(owner, name, timed)


def work(scene: str, adjoint: bool) -> None:
    """Compile the kernels of a scene in this process, and print what it took."""
    begin = time.process_time()
    from numba.core import codegen, typed_passes, untyped_passes

    from cqrun.build.model import build
    from cqrun.running.kernels import compile_kernels
    from cqrun.running.reporter import Silent
    from cqrun.scene.load import load_scene

    stages = Stages()
    for name, stage in LLVM.items():
        stages.watch(codegen.CPUCodeLibrary, name, stage)
    for module in (typed_passes, untyped_passes):
        for name, owner in list(vars(module).items()):
            if getattr(owner, "__module__", "") == module.__name__ and "run_pass" in vars(owner):
                stages.watch(owner, "run_pass", PASSES.get(name, "other passes"))
    built = build(load_scene(Path(scene)))
    ready = time.process_time()
    compile_kernels([built], Silent(), adjoint=adjoint)
    found = {"start": ready - begin, "compiling": time.process_time() - ready}
    functions, modules = (stages.calls[stage] for stage in ("types", "LLVM: machine code"))
    print(json.dumps({**found, **stages.seconds, "functions": functions, "machine codes": modules}))


def measured(checkout: Path, scene: str, adjoint: bool) -> dict[str, float]:
    """Return what a scene takes in a new process of a checkout, with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "PYTHONPATH": str(checkout), "NUMBA_CACHE_DIR": cache}
        worker = [str(Path(__file__).resolve()), "--worker", json.dumps([scene, adjoint])]
        command = [sys.executable, "-W", "ignore", *worker]
        done = subprocess.run(command, cwd=checkout, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return {name: round(value, 2) for name, value in json.loads(done.stdout).items()}


def main() -> None:
    """Print a table for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path, nargs="*", default=[ROOT])
    parser.add_argument("--scene", nargs="+", default=list(SCENES))
    parser.add_argument("--forward", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(*json.loads(options.worker))
        return
    result: dict[str, list[dict[str, float]]] = {}
    for scene in options.scene:
        result[scene] = [measured(folder.resolve(), scene, not options.forward) for folder in options.checkouts]
        print(scene)
        for name in dict.fromkeys(name for found in result[scene] for name in found):
            print(f"  {name:20s}" + "".join(f"{found.get(name, 0.0):9.2f}" for found in result[scene]), flush=True)
        if options.out:
            options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Run one implementation in a process of its own, pinned to one core, as standard input says.

    python -m benchmarks.peers.worker NAME SIZE CORE

The answer to a line `forward` or `backward` is the seconds it took; the answer to `results` is a JSON object.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time

PRECISIONS = {"cqrun": "float64", "cqrun_float32": "float32"}
"""Of cqrun's implementations; the peers compute in float32."""

NAMES = dict.fromkeys(PRECISIONS, "cqrun_mpm") | {"warp": "warp_mpm", "taichi": "taichi_mpm", "jax": "jax_mpm"}


def main(name: str, size: str, core: int) -> None:
    """Make the implementation, warm it up, and answer requests."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    os.sched_setaffinity(0, {core})
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # so that what libraries print is not read as an answer
    from benchmarks.peers.problem import block_of

    module = importlib.import_module(f"benchmarks.peers.{NAMES[name]}")
    made = module.make(size, PRECISIONS[name]) if name in PRECISIONS else module.make(block_of(size))
    begin = time.perf_counter()
    made.forward()
    made.backward()
    print(json.dumps({"first": time.perf_counter() - begin}), file=answers, flush=True)
    for line in sys.stdin:
        wanted = line.strip()
        if wanted == "results":
            found = {**made.results(), "backward_holds_forward": module.BACKWARD_HOLDS_FORWARD}
            print(json.dumps(found), file=answers, flush=True)
        else:
            begin = time.perf_counter()
            getattr(made, wanted)()
            print(json.dumps({"seconds": time.perf_counter() - begin}), file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))

"""Check with a small kernel that this machine compiles, caches and runs threads as the engine needs."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numba import config

from cqrun.engine.team import Team
from cqrun.numerics.compile import barrier, kernel, share
from cqrun.plugin.contract import Array

SIZE = 1 << 16


@dataclass(frozen=True)
class KernelCheck:
    """The result of the test kernel.

    Attributes:
        right: whether its results are bit-for-bit those of NumPy, on one thread and on all.
        origin: `compiled`, `from the cache`, or `plain Python` without the JIT.
        seconds: time of the first call [s].
    """

    right: bool
    origin: str
    seconds: float


@kernel
def _mirror(x, y, out, arrivals, thread, n_threads):  # type: ignore[no-untyped-def]
    low, high = share(x.size, thread, n_threads)
    for i in range(low, high):
        y[i] = 0.25 * x[i]
    barrier(arrivals, n_threads)
    # these entries were written by other threads: they are right only if the barrier works
    for i in range(low, high):
        out[i] = y[x.size - 1 - i]


def _run(n_threads: int) -> Array:
    x, y, out = np.arange(SIZE, dtype=np.float64), np.zeros(SIZE), np.zeros(SIZE)
    team = Team(n_threads)
    team.run(lambda thread: _mirror(x, y, out, team.arrivals, thread, n_threads))
    return out


def check_kernel(n_threads: int) -> KernelCheck:
    """Run the test kernel on one thread, then on `n_threads`, and return the result."""
    expected = 0.25 * np.arange(SIZE, dtype=np.float64)[::-1]
    start = time.perf_counter()
    right = bool(np.array_equal(_run(1), expected))
    seconds = time.perf_counter() - start
    if config.DISABLE_JIT:
        return KernelCheck(right, "plain Python", seconds)
    origin = "from the cache" if _mirror.stats.cache_hits else "compiled"
    return KernelCheck(right and bool(np.array_equal(_run(n_threads), expected)), origin, seconds)

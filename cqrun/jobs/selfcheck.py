"""A kernel that takes a second: does this machine compile, cache and run in parallel?"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numba
import numpy as np

SIZE = 1 << 16


@dataclass(frozen=True)
class KernelCheck:
    """What the test kernel found."""

    right: bool
    """Its answer is that of NumPy, bit for bit."""
    from_cache: bool
    """It was loaded from the kernel cache and not compiled."""
    seconds: float
    """Time of the first call [s]."""
    threads: int
    """Threads that Numba would use."""
    layer: str
    """Numba's threading layer, known only once a parallel kernel has run."""


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _axpy(a, x, y):  # type: ignore[no-untyped-def]
    out = np.empty_like(x)
    for i in numba.prange(x.size):
        out[i] = a * x[i] + y[i]
    return out


def check_kernel() -> KernelCheck:
    """Run the test kernel once and say what happened."""
    x, y = np.arange(SIZE, dtype=np.float64), np.full(SIZE, 0.5)
    start = time.perf_counter()
    out = _axpy(0.25, x, y)
    seconds = time.perf_counter() - start
    hits = sum(_axpy.stats.cache_hits.values()) if hasattr(_axpy, "stats") else 0
    # multiples of 1/4: exact, fused or not
    right = bool(np.array_equal(out, 0.25 * x + y))
    return KernelCheck(right, hits > 0, seconds, numba.get_num_threads(), _layer())


def _layer() -> str:
    return "none (JIT disabled)" if numba.config.DISABLE_JIT else str(numba.threading_layer())

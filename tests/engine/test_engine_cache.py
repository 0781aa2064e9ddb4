"""The cache of compiled kernels, where several processes fill it at once."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

from little_worlds import needs_jit
from numba.core import caching

from cqrun.numerics.compile import SharedIndex, kernel


class Slow(SharedIndex):
    """An index that leaves others time to get in between."""

    def _load_index(self):
        found = super()._load_index()
        time.sleep(0.005)
        return found


@needs_jit
def test_kernels_use_it():
    def nothing():
        return 0

    assert caching.IndexDataCacheFile is SharedIndex
    assert isinstance(kernel(nothing)._cache._cache_file, SharedIndex)


def test_every_version_keeps_its_own_code(tmp_path):
    """Each writer has an index of its own over one folder, as processes have."""

    def add(number: int) -> None:
        Slow(str(tmp_path), "step.advance", "stamp").save(f"version {number}", f"code {number}")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(add, range(24)))
    index = SharedIndex(str(tmp_path), "step.advance", "stamp")
    assert [index.load(f"version {number}") for number in range(24)] == [f"code {number}" for number in range(24)]
    assert len(list(tmp_path.glob("*.nbc"))) == 24

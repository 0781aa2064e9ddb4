"""The test kernel of `cqrun doctor`."""

from __future__ import annotations

import pytest
from numba import config

from cqrun.running import selfcheck


@pytest.mark.parametrize("n_threads", [1, 2, 3])
def test_the_kernel_is_right_on_any_number_of_threads(n_threads):
    check = selfcheck.check_kernel(n_threads)
    assert check.right
    assert check.origin in (["plain Python"] if config.DISABLE_JIT else ["compiled", "from the cache"])
    assert check.seconds > 0.0


def test_a_wrong_kernel_is_seen(monkeypatch):
    run = selfcheck._run
    monkeypatch.setattr(selfcheck, "_run", lambda n_threads: run(n_threads) + 1e-12)
    assert not selfcheck.check_kernel(1).right

"""Functions whose results must be bit-for-bit identical for all callers are not inlined."""

from __future__ import annotations

import pytest
from little_worlds import needs_jit
from numba import njit

from cqrun.numerics.compile import kernel, one_body


@one_body
def kept_apart(x):
    return x * 3.0 + 1.0


@kernel
def copied_in(x):
    return x * 3.0 + 1.0


@needs_jit
@pytest.mark.parametrize(("part", "has_body"), [(kept_apart, True), (copied_in, False)])
def test_a_function_of_one_body_is_called(part, has_body):
    caller = njit(lambda x: part(x) + part(x + 1.0))  # not cached, so that its code can be read
    assert caller(1.0) == 11.0
    (code,) = caller.inspect_asm().values()
    name = f"{len(part.__name__)}{part.__name__}"
    bodies = [line for line in code.splitlines() if name in line and line.endswith(":")]
    assert len(bodies) == has_body

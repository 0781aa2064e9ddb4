"""Checkpoints: which states a gradient keeps in its memory.

A rollout is cut into chunks of substeps. The states at the start of some chunks are kept (the choice is optimal:
`MultistageCheckpointSchedule`, Griewank and Walther, ACM TOMS 2000); the states inside a chunk are kept only while its
adjoint runs. So a gradient fits any budget of a few states, but repeats forward runs. Chunks begin at multiples of
`SORT_EVERY`, so that a repeated chunk gives bit-for-bit identical states.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from typing import Any

import numpy as np

from cqrun.engine.blocks import SORT_EVERY
from cqrun.errors import RunError
from cqrun.numerics.packed import aligned
from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class Plan:
    """A plan of checkpoints."""

    chunk: int  # substeps in a chunk
    n_chunks: int
    snapshots: int  # states kept at the start of chunks
    states: int  # largest number of kept states
    recompute: float  # forward substeps of a gradient divided by the substeps of the rollout
    backwards: bool = False  # whether a gradient runs the motion backwards, and keeps states to start again from only


def repetitions(n: int, snapshots: int) -> int:
    """Return the least number of chunk advances that reverse n chunks (Griewank and Walther 2000, eq 5).

    With the smallest t for which binomial(s + t, s) >= n, it is t n - binomial(s + t, t - 1), plus one more pass over
    each chunk to keep its states.
    """
    if n == 1:
        return 1
    reach, t = 1, 0
    while reach < n:
        t += 1
        reach = reach * (snapshots + t) // t
    # binomial(s + t, t - 1) = binomial(s + t, s) * t / (s + 1)
    return t * n - reach * t // (snapshots + 1) + n


@lru_cache(4096)  # `gradients_at_once` calls it for every number of gradients
def make_plan(n_steps: int, state_bytes: int, budget: int) -> Plan:
    """Return the plan with the least work in the budget; raise RunError if not even the shortest chunk fits."""
    states = budget // state_bytes
    if n_steps + 1 <= states:
        return Plan(max(n_steps, 1), 1, 0, n_steps + 1, 1.0)
    best: Plan | None = None
    chunk = SORT_EVERY
    while chunk + 2 <= states:
        n_chunks = -(-n_steps // chunk)
        snapshots = min(states - chunk - 1, n_chunks - 1)
        if snapshots >= 1:
            work = repetitions(n_chunks, snapshots) / n_chunks
            if best is None or work < best.recompute - 1e-12:
                best = Plan(chunk, n_chunks, snapshots, snapshots + chunk + 1, work)
        chunk += SORT_EVERY * max(1, chunk // (8 * SORT_EVERY))
    if best is None:
        need = (SORT_EVERY + 2) * state_bytes
        raise RunError(
            f"a gradient needs {SORT_EVERY + 2} states of {state_bytes / 2**20:.3g} MiB; the budget is "
            f"{budget / 2**20:.4g} MiB: set `memory: {need / 2**20 + 1:.0f}MiB` or more, or use fewer particles"
        )
    return best


@contextmanager
def borrowed(spare: list[Array], shape: tuple[int, ...], real: Any) -> Iterator[Array]:
    """Lend memory for states, and put it into `spare` for the next gradient; several threads may share `spare`.

    The operating system clears new memory page by page, which takes a fifth of an iteration.
    """
    need, memory = prod(shape) * np.dtype(real).itemsize, None
    with suppress(IndexError):  # not `if spare`: another thread may take the last entry in between
        memory = spare.pop()
    if memory is None or memory.nbytes < need:
        memory = None  # free the old memory before the new is allocated
        memory = aligned((need,), np.uint8)
    try:
        yield memory[:need].view(real).reshape(shape)
    finally:
        spare.append(memory)

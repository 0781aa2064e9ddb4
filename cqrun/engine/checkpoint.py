"""How many states are kept for a gradient, and which.

A rollout is cut into chunks of substeps. The states at the beginnings of some chunks are kept (their choice is
optimal: `MultistageCheckpointSchedule`, Griewank and Walther, ACM TOMS 2000), the states inside a chunk only
while its adjoint runs. So N substeps fit any budget of a few states, at the price of repeated forward runs.
Chunks begin at multiples of `SORT_EVERY`, so that a repeated chunk repeats its bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
    """`chunk` substeps in a chunk, `n_chunks` of them, and `snapshots` kept at the beginnings of chunks."""

    chunk: int
    n_chunks: int
    snapshots: int
    states: int  # kept at the most, all together
    recompute: float  # forward substeps run for one gradient, per substep


def repetitions(n: int, snapshots: int) -> int:
    """Return the least number of chunk advances that reverse n chunks (Griewank and Walther 2000, eq 5).

    With t the least repetition for which binomial(s + t, s) >= n, that is t n - binomial(s + t, t - 1), and
    one more pass over each chunk to keep its states.
    """
    if n == 1:
        return 1
    reach, t = 1, 0
    while reach < n:
        t += 1
        reach = reach * (snapshots + t) // t
    # binomial(s + t, t - 1) = binomial(s + t, s) * t / (s + 1)
    return t * n - reach * t // (snapshots + 1) + n


@lru_cache(4096)  # asked for every number of gradients side by side
def make_plan(n_steps: int, state_bytes: int, budget: int) -> Plan:
    """Return the plan of least work within the budget.

    Raises:
        RunError: not even the shortest chunk fits.
    """
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


def _taken(spare: list[Array]) -> Array | None:
    try:
        return spare.pop()
    except IndexError:  # asked beforehand, another thread might take the last one in between
        return None


@contextmanager
def borrowed(spare: list[Array], shape: tuple[int, ...], real: Any) -> Iterator[Array]:
    """Give memory for states, which the next gradient will use again.

    Memory that a process gives back is cleared page by page before it has it again: a fifth of an iteration.

    Args:
        spare: bytes that are not in use; several threads may share it.
    """
    need = prod(shape) * np.dtype(real).itemsize
    held = _taken(spare)
    if held is None or held.nbytes < need:
        held = None  # given back first: never both
        held = aligned((need,), np.uint8)
    try:
        yield held[:need].view(real).reshape(shape)
    finally:
        spare.append(held)

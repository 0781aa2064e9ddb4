"""What fitting and learning have in common: rollouts side by side, what they cost, and trials that may fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from cqrun.design.params import Params
from cqrun.engine.rollout import Rollout
from cqrun.errors import CrushedError, RolloutError
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array

T = TypeVar("T")


def side_by_side(tasks: Sequence[Callable[[int], T]], threads: int, at_once: int | None = None) -> list[T]:
    """Run tasks, each given its number of threads, and return their results in order.

    Where there are fewer tasks than threads, they share the threads evenly.

    Args:
        at_once: how many may run side by side; as many as there are threads, if not given.
    """
    at_once = min(threads, len(tasks), threads if at_once is None else at_once)
    if at_once <= 1:
        return [task(threads) for task in tasks]
    each = threads // at_once  # at least 1: no more than `threads` run at once
    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(lambda task: task(each), tasks))


@dataclass
class Effort:
    """What gradients cost: the greatest recompute factor, and states kept [bytes]."""

    recompute: float = 0.0
    peak: int = 0

    @classmethod
    def of(cls, rollout: Rollout) -> Effort:
        """Return what a rollout's gradients cost."""
        plan = rollout.plan
        return cls() if plan is None else cls(plan.recompute, plan.states * rollout.state_bytes)

    def add(self, other: Effort) -> None:
        """Take other gradients into account."""
        self.recompute, self.peak = max(self.recompute, other.recompute), max(self.peak, other.peak)


@contextmanager
def trial(params: Params, x: Array) -> Iterator[None]:
    """Have a rollout at x that is of no use raise TrialFailed, which names the parameters' values."""
    try:
        yield
    except RolloutError as error:
        raise TrialFailed(
            f"{error.reason}; {error.advice}", body=error.body, particle=error.particle, time=error.time,
            values=params.describe(x),
        ) from error  # fmt: skip
    except CrushedError as error:
        raise TrialFailed(str(error), values=params.describe(x)) from error


def the_value(answers: Sequence[float | TrialFailed]) -> float:
    """Return the only answer, or raise that its trial failed."""
    (answer,) = answers
    if isinstance(answer, TrialFailed):
        raise answer
    return answer

"""Tools that fitting and learning share: rollouts in parallel, their cost, and trials that may fail."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from cqrun.design.params import Params
from cqrun.engine.rollout import Rollout
from cqrun.errors import CrushedError, NoRestError, RolloutError, RunError
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array

T = TypeVar("T")


def side_by_side(tasks: Sequence[Callable[[int], T]], threads: int, at_once: int | None = None) -> list[T]:
    """Run tasks in parallel and return their results in order.

    If there are fewer tasks than threads, the tasks share the threads evenly.

    Args:
        tasks: functions of the number of threads that they may use.
        threads: number of threads for all of them.
        at_once: how many tasks may run at once; the number of threads if not given.
    """
    at_once = min(threads, len(tasks), threads if at_once is None else at_once)
    if at_once <= 1:
        return [task(threads) for task in tasks]
    each = threads // at_once  # at least 1: no more than `threads` run at once
    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(lambda task: task(each), tasks))


@dataclass
class Effort:
    """The cost of gradients: the largest recompute factor, and the largest size of the kept states [bytes].

    `backwards` says whether all of them ran the motion backwards, and `kept_because` why one of them did not, in a
    frame that can.
    """

    recompute: float = 0.0
    peak: int = 0
    backwards: bool = True
    kept_because: str = ""

    @classmethod
    def of(cls, rollout: Rollout) -> Effort:
        """Return the cost of a rollout's gradients."""
        plan = rollout.plan
        return cls() if plan is None else cls(
            plan.recompute, plan.states * rollout.state_bytes, plan.backwards, rollout.kept_because
        )  # fmt: skip

    @property
    def way(self) -> str:
        """How the gradients were found, as the end of a sentence; empty where there is only one way."""
        if self.backwards:
            return "; they ran the motion backwards"
        return f", because {self.kept_because}" if self.kept_because else ""

    def add(self, other: Effort) -> None:
        """Include the cost of other gradients."""
        self.recompute, self.peak = max(self.recompute, other.recompute), max(self.peak, other.peak)
        self.backwards = self.backwards and other.backwards
        self.kept_because = self.kept_because or other.kept_because


@contextmanager
def trial(params: Params, x: Array) -> Iterator[None]:
    """Turn errors of a rollout at x into TrialFailed, which names the recording and the parameters' values."""
    try:
        yield
    except RolloutError as error:
        raise TrialFailed(
            f"{_recording(error)}{error.reason}; {error.advice}", body=error.body, particle=error.particle,
            time=error.time, values=params.describe(x),
        ) from error  # fmt: skip
    except (CrushedError, NoRestError) as error:
        raise TrialFailed(f"{_recording(error)}{error}", values=params.describe(x)) from error


def _recording(error: RunError) -> str:
    """Return the recording of a fit whose run ended, as the beginning of a sentence."""
    return f"recording '{error.recording}': " if error.recording else ""


def the_value(answers: Sequence[float | TrialFailed]) -> float:
    """Return the only answer, or raise it if it is a failed trial."""
    (answer,) = answers
    if isinstance(answer, TrialFailed):
        raise answer
    return answer

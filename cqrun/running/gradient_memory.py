"""Plan how gradients fit the memory of a scene: which states are kept, and which substeps are run again."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite

from cqrun.build.model import Built
from cqrun.engine.checkpoint import Plan, make_plan
from cqrun.engine.forward_run import useful_threads
from cqrun.engine.model import Model
from cqrun.errors import Problem, RunError, SceneError

GRADIENT = 5.0
"""Time of a gradient divided by the time of a forward run, if all states fit the memory."""

THREAD_GAIN = 0.5
"""Speed-up of a rollout by each thread after the first, at least (decision 002)."""


def gradient_plan(built: Built) -> Plan:
    """Return the plan by which a gradient of a scene fits its memory.

    Raises:
        SceneError: a gradient needs more memory than the scene allows.
    """
    model = built.model
    try:
        return make_plan(model.n_steps, model.state_bytes, model.memory_budget)
    except RunError as error:
        raise SceneError([Problem(built.scene.where("memory"), "memory", str(error))]) from None


def gradients_at_once(models: Sequence[Model], threads: int) -> int:
    """Return how many gradients, one of each model, should run at once.

    This is the number for which all gradients finish soonest; of several such numbers it is the largest. If more run at
    once, each has less memory and fewer threads, and with few kept states it runs its substeps again and again.
    """
    distinct = list({id(model): model for model in models}.values())

    def time(at_once: int) -> float:
        rounds = -(-len(models) // at_once)
        return round(rounds * max(gradient_time(model, at_once, threads) for model in distinct), 9)

    times = {at_once: time(at_once) for at_once in range(min(threads, len(models)), 0, -1)}
    best = min(times, key=times.__getitem__, default=1)
    return best if isfinite(times.get(best, inf)) else 1


def gradient_time(model: Model, at_once: int, threads: int) -> float:
    """Return the time of one of `at_once` gradients, in forward runs on one thread; infinity if it does not fit."""
    try:
        plan = make_plan(model.n_steps, model.state_bytes, model.memory_budget // at_once)
    except RunError:
        return inf
    threads_each = useful_threads(model, threads // at_once)
    return (GRADIENT + plan.recompute - 1.0) / (1.0 + THREAD_GAIN * (threads_each - 1))

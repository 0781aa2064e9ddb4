"""What a scene's gradients need: states kept, substeps run again; refused before a run where it cannot be."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite

import numpy as np

from cqrun.controllers.policy import remembered
from cqrun.engine.checkpoint import Plan, make_plan
from cqrun.engine.model import Model
from cqrun.engine.rollout import useful_threads
from cqrun.errors import Problem, RunError, SceneError
from cqrun.jobs.agent import Agent
from cqrun.scene.build import Built
from cqrun.state import rows_of
from cqrun.units import format_bytes

GRADIENT = 5.0
"""What a gradient takes, in forward runs, where all states fit."""

THREAD_GAIN = 0.5
"""By how much a thread beside the first speeds a rollout up, at the least: decision 002."""

FORWARD, BACKWARD = 3, 2
"""Copies of an episode's records that it holds at the most; and beside them where there are gradients."""


def state_bytes(model: Model) -> int:
    """Return the bytes of one kept state."""
    return int(rows_of(model.dim)[-1] * model.layout.n * np.dtype(model.real).itemsize)


def gradient_plan(built: Built) -> Plan:
    """Return how a gradient of a scene fits its memory.

    Raises:
        SceneError: it does not.
    """
    model = built.model
    try:
        return make_plan(model.n_steps, state_bytes(model), model.memory_budget)
    except RunError as error:
        raise SceneError([Problem(built.scene.where("memory"), "memory", str(error))]) from None


def gradients_at_once(models: Sequence[Model], threads: int) -> int:
    """Return how many gradients, one of each model, should run side by side: of what ends soonest the most.

    The more there are, the less of the budget and the fewer threads each has: with few states it runs its substeps
    again and again.
    """
    distinct = list({id(model): model for model in models}.values())

    def time(at_once: int) -> float:
        rounds = -(-len(models) // at_once)
        return round(rounds * max(gradient_time(model, at_once, threads) for model in distinct), 9)

    times = {at_once: time(at_once) for at_once in range(min(threads, len(models)), 0, -1)}
    best = min(times, key=times.__getitem__, default=1)
    return best if isfinite(times.get(best, inf)) else 1


def gradient_time(model: Model, at_once: int, threads: int) -> float:
    """Return how long one of several gradients takes, in forward runs on one thread; without end if it does not fit."""
    try:
        plan = make_plan(model.n_steps, state_bytes(model), model.memory_budget // at_once)
    except RunError:
        return inf
    own = useful_threads(model, threads // at_once)
    return (GRADIENT + plan.recompute - 1.0) / (1.0 + THREAD_GAIN * (own - 1))


# --- beside the states: what is recorded at control steps -----------------------------------------------------------


def record_bytes(agent: Agent, functions: int) -> int:
    """Return the bytes that an episode needs beside its states, with the gradients of several functions of it.

    Its records are held as kernels and as terms see them, and so are the cotangents, those of every function till the
    end.
    """
    model = agent.model
    assert model.probe is not None
    copies = FORWARD + (BACKWARD + functions if functions else 0)
    numbers = copies * rows_of(model.dim)[-1] * model.probe.shape[0] + remembered(agent.observation, agent.limits)
    return int(np.dtype(np.float64).itemsize * (model.n_controls + 1) * numbers)


def require_records(agent: Agent, functions: int, at_once: int) -> None:
    """Refuse episodes whose records do not fit the memory that is free.

    Raises:
        SceneError: at what records most.
    """
    import psutil

    need, there = at_once * record_bytes(agent, functions), psutil.virtual_memory().available
    if need > there:
        rows = {"observers": agent.observation.rows.shape[0]}
        for key, terms in (("objective", agent.objective.terms), ("constraints", agent.constraints.terms)):
            rows |= {f"{key}.{name}": term.rows.shape[0] for name, term in terms.items()}
        path = max(rows, key=rows.__getitem__)
        message = (
            f"{rows[path]:,} of {sum(rows.values()):,} points recorded at {agent.model.n_controls:,} control steps, by "
            f"{at_once} {'episode' if at_once == 1 else 'episodes'} at once, need {format_bytes(need)}; "
            f"{format_bytes(there)} are free: take a part of the body, or fewer and longer control steps"
        )
        raise SceneError([Problem(agent.built.scene.where(path), path, message)])

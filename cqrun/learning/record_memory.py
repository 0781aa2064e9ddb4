"""The memory that an episode needs beside the kept states: what is recorded at control steps."""

from __future__ import annotations

import numpy as np

from cqrun.controllers.policy import memory_size
from cqrun.errors import Problem, SceneError
from cqrun.learning.agent import Agent
from cqrun.units import format_bytes

FORWARD, BACKWARD = 3, 2
"""Copies of an episode's records that it holds at most, and how many more where there are gradients."""


def record_bytes(agent: Agent, functions: int) -> int:
    """Return the bytes that an episode needs beside its states, with the gradients of several functions of it.

    Its records are held as kernels and as terms see them, and so are the cotangents, those of every function till the
    end.
    """
    model = agent.model
    assert model.probe is not None
    copies = FORWARD + (BACKWARD + functions if functions else 0)
    numbers = copies * model.layout.table.n_rows * model.probe.shape[0] + memory_size(agent.observation, agent.limits)
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

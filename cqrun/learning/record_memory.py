"""The memory that an episode needs for its records, in addition to the kept states."""

from __future__ import annotations

import numpy as np

from cqrun.controllers.policy import memory_size
from cqrun.errors import Problem, SceneError
from cqrun.learning.agent import Agent
from cqrun.memory import shortage

FORWARD, BACKWARD = 3, 2
"""Largest number of copies of an episode's records, and the additional number with gradients."""


def record_bytes(agent: Agent, functions: int) -> int:
    """Return the bytes that an episode needs in addition to its states, with gradients of a number of functions.

    Records and cotangents exist in the form of the kernels and in that of the terms; the cotangents of all functions
    exist until the end.
    """
    model = agent.model
    assert model.probe is not None
    copies = FORWARD + (BACKWARD + functions if functions else 0)
    numbers = copies * model.layout.table.n_rows * model.probe.shape[0] + memory_size(agent.observation, agent.limits)
    return int(np.dtype(np.float64).itemsize * (model.n_controls + 1) * numbers)


def require_records(agent: Agent, functions: int, at_once: int) -> None:
    """Raise SceneError, at the part with the most records, if the records of episodes do not fit the free memory."""
    rows = {"observers": agent.observation.rows.shape[0]}
    for key, terms in (("objective", agent.objective.terms), ("constraints", agent.constraints.terms)):
        rows |= {f"{key}.{name}": term.rows.shape[0] for name, term in terms.items()}
    path = max(rows, key=rows.__getitem__)
    what = (
        f"{rows[path]:,} of {sum(rows.values()):,} points recorded at {agent.model.n_controls:,} control steps, by "
        f"{at_once} {'episode' if at_once == 1 else 'episodes'} at once, need"
    )
    advice = "use a part of the body, or fewer and longer control steps"
    if message := shortage(what, at_once * record_bytes(agent, functions), advice):
        raise SceneError([Problem(agent.built.scene.where(path), path, message)])

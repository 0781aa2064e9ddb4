"""Save the best controller so far in its run directory, from the first iteration on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cqrun.learning.agent import FILE
from cqrun.learning.episodes import EpisodeProblem
from cqrun.learning.weak_observations import weak_observations
from cqrun.optimizers.constrained import ranked, violations_in_row
from cqrun.plugin.contract import Array
from cqrun.running.reporter import Reporter
from cqrun.running.runs import Progress, optimizer_of
from cqrun.store.history import read_history
from cqrun.store.run import RunDirectory


class Keeping(Progress):
    """Saves the controller of the best iteration so far, and warns at the start of weak observations.

    If the episodes change from iteration to iteration, losses cannot be compared: then it saves the last controller.
    """

    def __init__(self, run: RunDirectory, problem: EpisodeProblem, talk: Reporter) -> None:
        super().__init__(run, talk)
        optimizer: Any = optimizer_of(problem.built.scene)
        self._problem, self._tolerance = problem, getattr(optimizer, "constraint_tolerance", 0.0)
        self._latest = problem.stochastic or getattr(optimizer, "batch_size", None) is not None
        file = run.path / "history.csv"
        before = read_history(file) if (run.path / FILE).exists() and file.exists() else {}
        rows = [dict(zip(before, row, strict=True)) for row in zip(*before.values(), strict=True)]
        self._rank = min((self._of(row, row["loss"]) for row in rows), default=(np.inf, np.inf, np.inf))

    def _of(self, row: Mapping[str, float], loss: float) -> tuple[float, float, float]:
        return ranked(violations_in_row(self._problem, row), loss, self._tolerance)

    def __call__(self, iteration: int, x: Array, loss: float, terms: Mapping[str, float]) -> None:
        super().__call__(iteration, x, loss, terms)
        controller: Any = self._problem.built.scene.controller
        if iteration == 0 and controller.value.unit_inputs:
            for sentence in weak_observations(self._problem.agent.observation, self._problem.observations):
                self._talk.warn(sentence)
                self._run.log(sentence)
        rank = self._of(terms, loss)
        if rank < self._rank or self._latest:
            self._rank = rank
            self._problem.agent.save(self._run.path / FILE, self._problem.values(x))

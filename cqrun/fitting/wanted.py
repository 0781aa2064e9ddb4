"""A fit without data: the unknowns minimise the objective of a scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cqrun.build.matter import matter_of
from cqrun.build.model import Built
from cqrun.engine.model import Records
from cqrun.errors import Problem, SceneError
from cqrun.fitting.case import Case
from cqrun.measurements.comparison import Comparison
from cqrun.objectives.term import Objective
from cqrun.observers.matter import Matter, Unfit
from cqrun.observers.track import Track
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

NAME = "objective"
"""Name of the only case."""


def wanted_case(built: Built) -> Case:
    """Return the case of a scene's objective, with every goal at its position.

    Raises:
        SceneError: a term does not fit the scene, or does not measure a distance between motions.
    """
    scene, matter = built.scene, matter_of(built, {})
    terms: dict[str, Any] = {name: chosen.value for name, chosen in scene.objective.items()}
    try:
        objective = Objective(terms, matter)
    except Unfit as error:
        raise SceneError([_problem(scene, error.name, str(error))]) from error
    goals = {name: np.array(goal.position) for name, goal in scene.goals.items()}
    wanted = Wanted(objective, goals, matter)
    case = Case.probed(NAME, built, (wanted,))
    if problems := list(_no_distances(scene, terms, wanted.track(case.runner.still()), objective)):
        raise SceneError(problems)
    return case


def _no_distances(scene: Scene, terms: Mapping[str, Any], track: Track, objective: Objective) -> Iterator[Problem]:
    """Yield problems of terms whose smallest value is not 0, or that do not depend on the motion only."""
    for name, term in terms.items():
        bar = objective.values_vjp(track, {name: 1.0})
        beside = (bar.activation, bar.design, bar.strength, bar.rest_length, bar.friction, bar.terms, bar.weights)
        if any(part is not None for part in beside):
            message = "sysid takes only terms of the motion; `cqrun control` and `cqrun codesign` also take this one"
            yield _problem(scene, name, message)
        elif term.sense < 0 or term.least != 0 or term.weight <= 0:
            message = "sysid takes only terms that are 0 at best, such as `track` and `reach` with a positive weight"
            yield _problem(scene, name, message)


def _problem(scene: Scene, name: str, message: str) -> Problem:
    return Problem(scene.where(f"objective.{name}"), f"objective.{name}", message)


class Wanted(Comparison):
    """The terms of the objective over a rollout's records; each is a distance to the wanted motion."""

    def __init__(self, objective: Objective, goals: Mapping[str, Array], matter: Matter) -> None:
        self.objective, self.rows, self.goals, self.matter = objective, objective.rows, goals, matter

    def track(self, records: Records) -> Track:
        """Return the records in the form that the terms take."""
        nothing, matter = np.zeros((self.matter.n_controls, self.matter.n_actuators)), self.matter
        x, v, C, F = records
        parts = np.zeros(matter.n_parts)  # terms of strengths are refused
        return Track(
            x, v, C, F, nothing, self.goals, matter.control_step, matter.design, records.held, parts, parts,
            matter.terms, rest=matter.x, friction=parts, rigid=records.rigid,
        )  # fmt: skip

    def wanted(self) -> dict[str, Any]:
        """Return the goal positions [m] for the attributes of a trajectory."""
        return self.objective.wanted(self.goals)

    def residuals(self, records: Records, start: float) -> Array:
        """Return the root of the loss (1,)."""
        return np.sqrt([self.loss(records, start)])

    def loss(self, records: Records, start: float) -> float:
        """Return the sum over terms of weight * value."""
        return self.objective.loss(self.track(records))

    def loss_vjp(self, records: Records, start: float, loss_bar: float = 1.0) -> tuple[Records, float]:
        """Return the cotangent of the records from that of the loss, and 0 as that of `start`."""
        bar = self.objective.loss_vjp(self.track(records), loss_bar)
        out = replace(records.zeros_like(), **{k: b for k in "xvCF" if (b := getattr(bar, k)) is not None})
        out.add_by_name(bar.by_name)
        return out, 0.0

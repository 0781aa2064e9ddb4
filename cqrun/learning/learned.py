"""Write the results of a run of control or co-design.

controller.npz    the best parameters of the controller
trajectory.h5     the first episode with it
activation.csv    the activations in this episode
measurements.csv  the quantities that the scene measures, in this episode
result.json       the objective's terms at the start and at the end, on the goals of the training and on unseen goals;
                  episodes that blew up; the constraints, and the unknowns of the design
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cqrun.design.params import Block
from cqrun.errors import RolloutError
from cqrun.learning.agent import CONTROLLER, FILE, Attempt, Goals
from cqrun.learning.episodes import EpisodeProblem
from cqrun.optimizers.base import Outcome
from cqrun.optimizers.constrained import AT_BOUND
from cqrun.plugin.contract import Array
from cqrun.running.measuring import Measuring, write_measured
from cqrun.running.side_by_side import side_by_side
from cqrun.running.trajectories import as_found, write_activation, write_trajectory
from cqrun.scene.schema import Scene
from cqrun.store.result import (
    AtBounds,
    ConstraintValue,
    Designed,
    Episode,
    LearnedResult,
    LostEpisode,
    Stage,
    StageName,
    write_result,
)
from cqrun.store.run import RunDirectory

STAGES: dict[StageName, str] = {"start": "before", "trained": "learned", "unseen": "on unseen goals"}
"""The names in tables of the stages of a result (`LearnedResult.stages`)."""


@dataclass(frozen=True)
class Lost:
    """An episode that blew up: its goals and the error."""

    goals: Goals
    error: RolloutError


Tried = Sequence[Attempt | Lost]


def write_learned(run: RunDirectory, problem: EpisodeProblem, outcome: Outcome) -> LearnedResult:
    """Write the controller, its first episode and result.json; return the result.

    Raises:
        RolloutError: with the learned parameters all episodes of the training blow up.
    """
    values, failed = problem.values(outcome.x), outcome.status == "failed"
    result = LearnedResult(
        job=run.record["job"],
        status=outcome.status,
        message=outcome.message,
        loss=float(outcome.loss) if np.isfinite(outcome.loss) else None,
        iterations=outcome.iterations,
        substeps=problem.built.model.substeps,
        unknowns={
            b.path: _designed(b, values[b.path]) for b in problem.params.blocks if not b.path.startswith(CONTROLLER)
        },
    )
    if not failed:
        problem.agent.save(run.path / FILE, values)
        goals, unseen = problem.goals(None), problem.unseen()
        tried: dict[StageName, Tried] = {"start": _run_all(problem, problem.values(problem.start), goals)}
        learned = _run_all(problem, values, [*goals, *unseen])
        tried |= {"trained": learned[: len(goals)], "unseen": learned[len(goals) :]}
        result.start, result.trained, result.unseen = (_stage(problem, _done(tried[name])) for name in STAGES)
        result.blew_up = {stage: lost for stage, attempts in tried.items() if (lost := _lost(attempts))}
        result.constraints = _before_and_after(problem, _done(tried["start"]), _done(tried["trained"]))
        shown = next((a for a in tried["trained"] if isinstance(a, Attempt)), None)
        if shown is None:
            raise next(a.error for a in learned if isinstance(a, Lost))
        write_activation(run.path / "activation.csv", problem.built, shown.activation)
        problem.interrupt()
        rollout = problem.agent.rollout(values, shown.goals, problem.threads)
        unknowns = {path: value for path, value in values.items() if not path.startswith(CONTROLLER)}
        provenance = problem.agent.wanted(shown.goals) | as_found(unknowns)
        measuring, file = Measuring(problem.built, unknowns), run.path / "trajectory.h5"
        write_trajectory(file, problem.built, rollout, measuring=measuring, provenance=provenance)
        write_measured(run.path, measuring, result)
    write_result(run.path, result)
    return result


def blown_up(result: LearnedResult) -> Iterator[str]:
    """Yield a sentence on each stage of a result in which episodes blew up."""
    for name, lost in result.blew_up.items():
        stage = result.stages().get(name)
        total = len(lost) + (0 if stage is None else len(stage.episodes))
        verb = "is" if len(lost) == 1 else "are"
        yield f"{STAGES[name]}: {len(lost)} of {total} episodes blew up and {verb} in no mean: {lost[0].message}"


def _run_all(problem: EpisodeProblem, values: dict[str, Array], goals: Sequence[Goals]) -> list[Attempt | Lost]:
    def task(goal: Goals) -> Any:
        def run(threads: int) -> Attempt | Lost:
            problem.interrupt()
            try:
                return problem.attempt(values, goal, threads)
            except RolloutError as error:
                return Lost(goal, error)

        return run

    return side_by_side([task(goal) for goal in goals], problem.threads)


def _done(tried: Tried) -> list[Attempt]:
    return [attempt for attempt in tried if isinstance(attempt, Attempt)]


def _designed(block: Block, value: Array) -> Designed:
    """Return an unknown's first and last values, and how many of the last ones are at its lower and upper bound."""
    scaled = block.to_scaled(np.asarray(value, float))
    ends = AtBounds(lower=int(np.sum(scaled <= AT_BOUND)), upper=int(np.sum(scaled >= 1 - AT_BOUND)))
    return Designed(initial=np.asarray(block.initial).tolist(), value=np.asarray(value).tolist(), at_bounds=ends)


def _lost(tried: Tried) -> list[LostEpisode]:
    return [LostEpisode(goals=_plain(a.goals), message=str(a.error)) for a in tried if isinstance(a, Lost)]


def _plain(goals: Goals) -> dict[str, list[float]]:
    return {name: goal.tolist() for name, goal in goals.items()}


def constraints_of(scene: Scene, attempts: Sequence[Attempt]) -> dict[str, ConstraintValue]:
    """Return every constraint's limits, its mean over episodes, and its violation."""
    values = {}
    for name, c in scene.constraints.items() if attempts else ():
        value = float(np.mean([a.constraints[name] for a in attempts]))
        values[name] = ConstraintValue(
            at_least=c.at_least, at_most=c.at_most, equals=c.equals, value=value,
            violation=max(0.0, c.low - value, value - c.high),
        )  # fmt: skip
    return values


def _before_and_after(
    problem: EpisodeProblem, before: Sequence[Attempt], after: Sequence[Attempt]
) -> dict[str, ConstraintValue]:
    """Return `constraints_of` the end, with the values at the start."""
    start, end = (constraints_of(problem.built.scene, attempts) for attempts in (before, after))
    return {name: end[name].model_copy(update={"start": start[name].value}) for name in start if name in end}


def _stage(problem: EpisodeProblem, attempts: Sequence[Attempt]) -> Stage | None:
    """Return the mean loss and terms over episodes, and those of each episode with its goals; None without episodes."""
    if not attempts:
        return None
    return Stage(
        loss=float(np.mean([a.loss for a in attempts])),
        terms={name: float(np.mean([a.terms[name] for a in attempts])) for name in problem.summands},
        episodes=[Episode(goals=_plain(a.goals), loss=a.loss, terms=a.terms) for a in attempts],
    )

"""The loss of an episode, as `cqrun gradcheck` differentiates it."""

from __future__ import annotations

import numpy as np

from cqrun.learning.agent import Attempt, Mix
from cqrun.learning.episodes import EpisodeProblem
from cqrun.plugin.contract import Array
from cqrun.running.state_loss import INSIDE, Loss


def episode_loss(problem: EpisodeProblem) -> Loss:
    """Return the first episode's loss plus its constraints, each divided by its scale.

    It is a function of the controller's parameters and the unknowns, at their start values.
    """
    lower, upper = problem.params.bounds
    bounded = np.isfinite(lower) & np.isfinite(upper)
    inset = INSIDE * np.where(bounded, upper, 0.0) - INSIDE * np.where(bounded, lower, 0.0)
    x = np.clip(problem.params.start, lower + inset, upper - inset)
    goals, budget = problem.goals(None)[0], problem.agent.model.memory_budget

    mix = Mix(1.0, dict(zip(problem.constraint_names, 1.0 / problem.scales, strict=True)))

    def total(attempt: Attempt) -> float:
        return attempt.loss + sum(factor * attempt.constraints[name] for name, factor in mix.constraints.items())

    def value(x: Array) -> float:
        return total(problem.attempt(problem.values(x), goals, problem.threads))

    def value_and_grad(x: Array) -> tuple[float, Array]:
        attempt, (gradient,) = problem.attempt_with_gradients(
            problem.values(x), goals, problem.threads, budget, lambda attempt: [mix]
        )
        return total(attempt), problem.params.gradient(x, gradient)

    first = problem.attempt(problem.values(x), goals, problem.threads)
    parts = [problem.agent.objective.factors.get(name, 1.0) * value for name, value in first.terms.items()]
    parts += [factor * first.constraints[name] for name, factor in mix.constraints.items()]
    scale = sum(map(abs, parts))
    moved = "" if np.array_equal(x, problem.params.start) else ", a little inside the bounds"
    words = "the first episode's loss" + (" and constraints" if mix.constraints else "")
    return Loss(f"{words}{moved}", problem.params, x, value, value_and_grad, float(scale))

"""Describe an agent in words: observers, controller, goals, objective and constraints."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cqrun.explain import listed
from cqrun.learning.agent import CONTROLLER, Agent
from cqrun.learning.episodes import EpisodeProblem, differentiated
from cqrun.learning.record_memory import record_bytes
from cqrun.running.bodies import point
from cqrun.running.runs import optimizer_of
from cqrun.running.tables import number
from cqrun.scene.schema import Scene
from cqrun.store.result import ConstraintValue
from cqrun.units import format_bytes


def line(what: str, text: str) -> str:
    """Return a line of the table with its subject in the first column."""
    return f"  {what:10} {text}"


def control_lines(agent: Agent, learned: EpisodeProblem | None) -> Iterator[str]:
    """Yield lines on observers, controller, goals and objective, and on the episodes if it is learned."""
    scene, seen = agent.built.scene, agent.observation
    for name, place in seen.parts.items():
        size = place.stop - place.start
        yield line("observer", f"{name} ({scene.observers[name].name}): {_count(size, 'number')}")
    yield from _controller(agent, 0 if learned is None else differentiated(learned))
    for name, goal in scene.goals.items():
        spread = f", drawn within {point(goal.spread or [])} m to either side" if goal.drawn else ""
        yield line("goal", f"{name}: {point(goal.position)} m{spread}")
    if learned is not None:
        yield from _episodes(learned)
    yield from objective_lines(scene)
    for name, constraint in scene.constraints.items():
        ends = {"at least": constraint.at_least, "at most": constraint.at_most, "equal to": constraint.equals}
        limits = ", ".join(f"{word} {number(end)}" for word, end in ends.items() if end is not None)
        optimizer: Any = optimizer_of(agent.built.scene)
        tolerance = number(optimizer.constraint_tolerance * constraint.scale)
        yield line("constraint", f"{name} ({constraint.of.name}): {limits}, with a tolerance of {tolerance}")


def objective_lines(scene: Scene) -> Iterator[str]:
    """Yield a line on each term of the objective."""
    for name, chosen in scene.objective.items():
        spec: Any = chosen.value
        aim = "larger is better" if spec.sense < 0 else "smaller is better"
        yield line("objective", f"{name} ({chosen.name}): {spec.over}, weight {number(spec.weight)}, {aim}")


def _controller(agent: Agent, functions: int) -> Iterator[str]:
    scene, low, high = agent.built.scene, agent.limits.low, agent.limits.high
    shapes = [
        f"{b.path.removeprefix(CONTROLLER)} {' x '.join(map(str, b.initial.shape)) or '1'}"
        for b in agent.params.blocks
        if b.path.startswith(CONTROLLER)
    ]
    count = sum(b.size for b in agent.params.blocks if b.path.startswith(CONTROLLER))
    sees = _count(agent.observation.size, "number") if agent.controller.closed_loop else "time alone"
    yield line("controller", f"{agent.controller.name}: {_count(count, 'parameter')} ({listed(shapes)})")
    pairs = [f"{number(a)} to {number(b)}" for a, b in sorted(set(zip(low.tolist(), high.tolist(), strict=True)))]
    drives = f"{_count(len(low), 'activation')} within {listed(pairs)}"
    yield line("", f"from {sees} to {drives}, every {number(scene.time.control_step)} s")
    kept = format_bytes(record_bytes(agent, functions))
    yield line("", f"besides its states, an episode keeps {kept} of observations, memory and records")


def _episodes(problem: EpisodeProblem) -> Iterator[str]:
    episodes, optimizer = problem.built.scene.episodes, optimizer_of(problem.built.scene)
    how = "one, because no goal is drawn"
    if problem.stochastic:
        how = f"{problem.n_episodes}, with fresh goals at every iteration"
    elif problem.n_episodes > 1 or any(g.drawn for g in problem.built.scene.goals.values()):
        how = f"a fixed set of {problem.n_episodes}"
    tested = f"; the result is tested on {episodes.unseen} more" if episodes.unseen else ""
    yield line("episodes", f"{how}{tested}")
    yield line("optimizer", f"{optimizer.name}, at most {_count(optimizer.max_iterations, 'iteration')}")


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}" + ("" if n == 1 else "s")


def constraint_cells(constraint: ConstraintValue) -> tuple[str, ...]:
    """Return a constraint's limits, and its numbers: the value before, if there is one, the value and the violation."""
    ends = {"at least": constraint.at_least, "at most": constraint.at_most, "": constraint.equals}
    limits = ", ".join(f"{word} {number(end)}".strip() for word, end in ends.items() if end is not None)
    return limits, *(number(n) for n in (constraint.start, constraint.value, constraint.violation) if n is not None)

"""`cqrun control` and `cqrun codesign`: learn how a body should move, and what it should be.

controller.npz keeps the controller's parameters that did best, from the first iteration on; what is written at the end
is in learning/learned.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.explain import listed
from cqrun.jobs.bodies import tell_bodies
from cqrun.learning.agent import FILE, Agent
from cqrun.learning.episodes import EpisodeProblem
from cqrun.learning.learned import blown_up, write_learned
from cqrun.learning.record_memory import require_records
from cqrun.learning.weak_observations import faint
from cqrun.optimizers.base import Optimizer
from cqrun.optimizers.constrained import (
    VIOLATION,
    ConstrainedOptimizer,
    ReplayedConstrained,
    excess_told,
    ranked,
    report_names,
)
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugins
from cqrun.running.gradient_memory import gradient_plan, gradients_at_once
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import (
    Progress,
    build_and_warn,
    finished_already,
    open_run,
    raise_if_failed,
    require_extension,
    saved_scene,
    stopping,
)
from cqrun.running.threads import cores
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.schema import Scene
from cqrun.store.history import read_history
from cqrun.store.run import RunDirectory
from cqrun.store.session import RunSession

JOBS = ("control", "codesign")

NEEDED = {
    "actuators": "say what drives the body",
    "controller": "say what drives the actuators, such as `open_loop: {}` or `mlp: {}`",
    "objective": "say what the motion is for, such as `far: {distance: {body: ..., axis: x}}`",
}
DESIGN = {"unknowns": "say what of the design may change, such as a material's `youngs_modulus: {bounds: [...]}`"}
"""What a scene must have to be learned, and for a design, and the advice where it is missing."""

NOUGHT = 1e-15
"""A gradient's norm, over a loss of 1 or more, below which nothing can be learned from it."""

FLAT = (
    "the gradient was nought at every iteration: nothing was learned. A `minimum` or `maximum` over time that the "
    "start itself holds has no slope, nor has an actuator whose motion the objective does not see: take a mean over "
    "time, or start elsewhere"
)


def run_control(
    source: Path | str,
    overrides: Sequence[str],
    out: Path | str,
    *,
    fresh: bool = False,
    threads: int | None = None,
    job: str = "control",
    reporter: Reporter | None = None,
) -> Path:
    """Learn a scene's controller, or that and its design (job `codesign`); return the run's directory.

    Raises:
        SceneError, UsageError: bad input. RunError: the run failed. Stopped: it can be resumed.
    """
    source, out = Path(source), Path(out)
    talk, n_threads = reporter or Silent(), cores(threads)
    problem = prepare(load_scene(source, overrides), n_threads, talk, job)
    with open_run(
        source.stem, problem.built.scene, out, job=job, threads=n_threads, fresh=fresh, with_data=False
    ) as run:
        if finished_already(run, talk):
            return raise_if_failed(run)
        if run.record.get("extended"):
            problem = prepare(saved_scene(run), n_threads, talk, job)
        return learn(run, problem, talk)


def prepare(scene: Scene, threads: int, talk: Reporter, job: str = "control") -> EpisodeProblem:
    """Return the problem of a scene, its optimizer chosen.

    Raises:
        SceneError: it lacks something, its optimizer is not for it, or there is too little memory for it.
    """
    needed = NEEDED | (DESIGN if job == "codesign" else {})
    missing = [key for key in needed if not getattr(scene, key) and not (key == "objective" and scene.constraints)]
    if missing:
        raise SceneError([Problem(scene.where(key), key, f"{job} needs it: {needed[key]}") for key in missing])
    if scene.optimizer is None:
        usual = plugins("optimizer")["sqp" if scene.constraints else "adam"]
        scene = scene.with_plugin("optimizer", usual())
    if scene.data is not None:
        talk.warn(f"{scene.where('data')}: data: {job} reads no recordings; `cqrun sysid` does")
    if job == "control" and scene.unknowns:
        talk.warn(
            f"{scene.where('unknowns')}: unknowns: {listed(list(scene.unknowns))} learned beside the controller; "
            "`-o unknowns={}` holds the design as it is"
        )
    built = build_and_warn(scene, talk)
    optimizer = optimizer_of(built)
    if optimizer.gradients:
        gradient_plan(built)
    problem = EpisodeProblem(Agent(built), threads=threads)
    try:
        optimizer.require(problem)
        if optimizer.squares:
            others = listed(_able()) if scene.constraints else "adam, sgd, lbfgs or cma_es"
            raise UsageError(f"fits data by least squares; for an objective take {others}")
        if scene.constraints and not isinstance(optimizer, ConstrainedOptimizer):
            raise UsageError(f"honours no constraints; take {listed(_able())}, or remove `constraints`")
    except UsageError as error:
        path = f"optimizer.{optimizer.name}"
        raise SceneError([Problem(scene.where(path), path, str(error))]) from error
    count = min(problem.n_episodes, getattr(optimizer, "batch_size", None) or problem.n_episodes)
    functions = differentiated(problem)
    at_once = gradients_at_once([problem.agent.model] * count, threads) if functions else min(threads, count)
    require_records(problem.agent, functions, at_once)
    return problem


def differentiated(problem: EpisodeProblem) -> int:
    """Return of how many functions of an episode the scene's optimizer takes gradients, all in one backward run."""
    optimizer = optimizer_of(problem.built)
    if not optimizer.gradients:
        return 0
    return 1 + (len(problem.constraint_names) if isinstance(optimizer, ReplayedConstrained) else 0)


def optimizer_of(built: Built) -> Optimizer:
    """Return a scene's optimizer."""
    assert built.scene.optimizer is not None
    optimizer = built.scene.optimizer.value
    assert isinstance(optimizer, Optimizer)
    return optimizer


def resume_control(run: RunDirectory, overrides: Sequence[str], threads: int, talk: Reporter) -> Path:
    """Continue a run from its directory; overrides may only extend the optimizer's iterations."""
    require_extension(run, overrides)
    problem = prepare(saved_scene(run, overrides), threads, talk, str(run.record["job"]))
    if overrides:
        run.extend(dump(resolve(problem.built.scene)), list(overrides))
    elif finished_already(run, talk, asked_by_scene=False):
        return raise_if_failed(run)
    return learn(run, problem, talk)


def learn(run: RunDirectory, problem: EpisodeProblem, talk: Reporter) -> Path:
    """Run or continue the learning in a run directory."""
    built, params = problem.built, problem.params
    optimizer = optimizer_of(built)
    compile_kernels([built], talk, adjoint=optimizer.gradients)
    run.begin(problem.threads)
    tell_bodies(built, run, talk)
    episodes = "an episode" if problem.n_episodes == 1 else f"{problem.n_episodes} episodes"
    talk.phase(f"learning {len(params.start)} parameters, {episodes} an iteration")
    talk.begin(optimizer.max_iterations)
    session = RunSession(
        run, seed=built.scene.seed, blocks=params.slices, physical=params.physical,
        term_names=[*problem.term_names, *report_names(problem)], stop=lambda: talk.stop.asked,
        progress=Keeping(run, problem, talk),
    )  # fmt: skip
    outcome = optimizer.minimise(problem, session)
    if outcome.status == "stopped":
        run.finish("stopped", outcome.message)
        raise talk.stop.stopped(f"{outcome.message}; `cqrun resume {run.path}` continues")
    if optimizer.gradients and outcome.status != "failed" and _flat(run):
        talk.warn(FLAT)
        run.log(FLAT)
    if outcome.status != "failed":
        talk.phase("what was learned, trajectory")
    problem.interrupt = stopping(run, talk)
    for lost in blown_up(write_learned(run, problem, outcome)):
        run.log(lost)
    run.finish(outcome.status, outcome.message)
    return raise_if_failed(run)


def _able() -> list[str]:
    """Return the optimizers that honour constraints."""
    return [name for name, cls in plugins("optimizer").items() if issubclass(cls, ConstrainedOptimizer)]


def _flat(run: RunDirectory) -> bool:
    """Say whether the gradient was nought at every iteration."""
    history = read_history(run.path / "history.csv")
    if np.any(history.get(VIOLATION, 0.0)):
        return False  # without an objective there is but the way to the constraints
    norms = [column for name, column in history.items() if name.startswith("grad:")]
    greatest = max((np.nanmax(np.abs(column), initial=0.0) for column in norms), default=np.inf)
    return bool(greatest <= NOUGHT * max(1.0, np.nanmax(np.abs(history["loss"]), initial=0.0)))


class Keeping(Progress):
    """Keeps the controller of the best iteration so far in the run's directory, for who cannot wait.

    At the start it tells whether the controller hardly feels what it sees.

    Where episodes change from iteration to iteration, losses are not of the same: the last one is kept.
    """

    def __init__(self, run: RunDirectory, problem: EpisodeProblem, talk: Reporter) -> None:
        super().__init__(run, talk)
        optimizer: Any = optimizer_of(problem.built)
        self._problem, self._tolerance = problem, getattr(optimizer, "constraint_tolerance", 0.0)
        self._latest = problem.stochastic or getattr(optimizer, "batch_size", None) is not None
        file = run.path / "history.csv"
        before = read_history(file) if (run.path / FILE).exists() and file.exists() else {}
        rows = [dict(zip(before, row, strict=True)) for row in zip(*before.values(), strict=True)]
        self._rank = min((self._of(row, row["loss"]) for row in rows), default=(np.inf, np.inf, np.inf))

    def _of(self, row: Mapping[str, float], loss: float) -> tuple[float, float, float]:
        return ranked(excess_told(self._problem, row), loss, self._tolerance)

    def __call__(self, iteration: int, x: Array, loss: float, terms: Mapping[str, float]) -> None:
        super().__call__(iteration, x, loss, terms)
        controller: Any = self._problem.built.scene.controller
        if iteration == 0 and controller.value.unit_inputs:
            for told in faint(self._problem.agent.observation, self._problem.saw):
                self._talk.warn(told)
                self._run.log(told)
        rank = self._of(terms, loss)
        if rank < self._rank or self._latest:
            self._rank = rank
            self._problem.agent.save(self._run.path / FILE, self._problem.values(x))

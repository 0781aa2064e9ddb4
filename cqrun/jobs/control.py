"""`cqrun control` and `cqrun codesign`: learn how a body moves, or its motion and its design together.

During the run controller.npz has the best parameters so far; learning/learned.py lists the files of a finished run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.errors import Problem, SceneError, UsageError
from cqrun.explain import listed
from cqrun.jobs.job import NO_FILES, Job, Need
from cqrun.learning.agent import Agent
from cqrun.learning.description import constraint_cells
from cqrun.learning.episodes import EpisodeProblem, differentiated
from cqrun.learning.keeping import Keeping
from cqrun.learning.learned import STAGES, blown_up, write_learned
from cqrun.learning.record_memory import require_records
from cqrun.optimizers.constrained import VIOLATION, ConstrainedOptimizer, report_names
from cqrun.plugin.registry import plugins
from cqrun.running.bodies import report_bodies
from cqrun.running.cost import about
from cqrun.running.gradient_memory import gradient_plan, gradients_at_once
from cqrun.running.kernels import compile_kernels
from cqrun.running.measuring import measured_lines
from cqrun.running.reporter import Reporter
from cqrun.running.runs import build_and_warn, optimizer_of
from cqrun.running.tables import number, table
from cqrun.scene.schema import Scene
from cqrun.store.history import read_history
from cqrun.store.result import Designed, LearnedResult, Value
from cqrun.store.run import RunDirectory
from cqrun.store.session import RunSession

ZERO = 1e-15
"""A gradient with a smaller norm, relative to the loss if that is larger than 1, counts as zero."""

FLAT = (
    "the gradient was zero at every iteration: nothing was learned. It is zero if a `minimum` or `maximum` over time "
    "is that of the start of the motion, or if the objective does not depend on what the actuators move: take a mean "
    "over time, or start elsewhere"
)


@dataclass(frozen=True)
class Learning(Job[EpisodeProblem, LearnedResult]):
    """Learn a scene's controller, or that and its design."""

    def prepare(
        self, scene: Scene, threads: int, talk: Reporter, files: Mapping[str, Path] = NO_FILES
    ) -> EpisodeProblem:
        """Return the problem of a scene with its optimizer.

        Raises:
            SceneError: a section is missing, the optimizer does not fit, or there is too little memory.
        """
        self.require_sections(scene)
        if scene.optimizer is None:
            usual = plugins("optimizer")["sqp" if scene.constraints else "adam"]
            scene = scene.with_plugin("optimizer", usual())
        if scene.data is not None:
            talk.warn(f"{scene.where('data')}: data: {self.name} reads no recordings; `cqrun sysid` does")
        if self.name == "control" and scene.unknowns:
            talk.warn(
                f"{scene.where('unknowns')}: unknowns: {listed(list(scene.unknowns))} learned together with the "
                "controller; `-o unknowns={}` keeps the design fixed"
            )
        built = build_and_warn(scene, talk)
        optimizer = optimizer_of(built.scene)
        if optimizer.gradients:
            gradient_plan(built)
        problem = EpisodeProblem(Agent(built), threads=threads)
        _require_fitting(problem)
        count = min(problem.n_episodes, getattr(optimizer, "batch_size", None) or problem.n_episodes)
        functions = differentiated(problem)
        at_once = gradients_at_once([problem.agent.model] * count, threads) if functions else min(threads, count)
        require_records(problem.agent, functions, at_once)
        return problem

    def reads_data(self, scene: Scene) -> bool:
        """Return False: an episode reads no recordings."""
        return False

    def work(self, run: RunDirectory, problem: EpisodeProblem, talk: Reporter) -> None:
        """Run or continue the learning."""
        built, params = problem.built, problem.params
        optimizer = optimizer_of(built.scene)
        compile_kernels([built], talk, adjoint=optimizer.gradients)
        run.begin(problem.threads)
        report_bodies(built, run, talk)
        problem.interrupt = talk.stop.check
        episodes = "an episode" if problem.n_episodes == 1 else f"{problem.n_episodes} episodes"
        lasts = about(built.model, gradients=optimizer.gradients, each="an episode")
        talk.phase(f"learning {len(params.start)} parameters, {episodes} an iteration, {lasts}")
        talk.begin(optimizer.max_iterations)
        session = RunSession(
            run, seed=built.scene.seed, blocks=params.slices, physical=params.physical,
            term_names=[*problem.term_names, *report_names(problem)], stop=lambda: talk.stop.asked,
            progress=Keeping(run, problem, talk),
        )  # fmt: skip
        outcome = optimizer.minimise(problem, session)
        if outcome.status == "stopped":
            run.finish("stopped", talk.stop.named(outcome.message))
            raise talk.stop.stopped(f"{outcome.message}; `cqrun resume {run.path}` continues")
        if optimizer.gradients and outcome.status != "failed" and _flat(run):
            talk.warn(FLAT)
            run.log(FLAT)
        if outcome.status != "failed":
            talk.phase(f"writing result and trajectory, {about(built.model, each='an episode')}")
        for sentence in blown_up(write_learned(run, problem, outcome)):
            run.log(sentence)
        run.finish(outcome.status, outcome.message)

    def lines(self, run: Path, result: LearnedResult) -> Iterator[str]:
        """Yield tables of the terms before and after, the constraints, and the unknowns of the design."""
        yield f"{result.status} after {result.iterations} iterations: {result.message}"
        yield from _which_iterate(run, result)
        stages = result.stages()
        if not stages:
            return
        yield ""
        terms = next(iter(stages.values())).terms
        rows = [(term, *(number(stage.terms[term]) for stage in stages.values())) for term in terms]
        rows.append(("loss", *(number(stage.loss) for stage in stages.values())))
        yield from table(("term", *(STAGES[name] for name in stages)), rows)
        yield from blown_up(result)
        if result.constraints:
            yield ""
            rows = [(name, *constraint_cells(value)) for name, value in result.constraints.items()]
            yield from table(("constraint", "wanted", "before", "learned", "violated by"), rows)
        if result.unknowns:
            yield ""
            design = [(path, _range(u.initial), _range(u.value), _ends(u)) for path, u in result.unknowns.items()]
            yield from table(("unknown", "before", "learned", "at its bounds"), design)
            yield from result.how_found()
        yield from measured_lines(result.measured)


NEEDS = (
    Need("actuators", "say what drives the body"),
    Need("controller", "say what drives the actuators, such as `open_loop: {}` or `mlp: {}`"),
    Need("objective", "say what the motion is for, such as `far: {distance: {body: ..., axis: x}}`", "constraints"),
)
DESIGN = Need("unknowns", "say what of the design may change, such as a material's `youngs_modulus: {bounds: [...]}`")
CONTROL = Learning(
    "control", LearnedResult, needs=NEEDS, pictures=("convergence", "bodies", "measured", "overview"), extensible=True
)
CODESIGN = Learning(
    "codesign", LearnedResult, needs=(*NEEDS, DESIGN),
    pictures=("convergence", "bodies", "design", "shape", "measured", "overview"), extensible=True,
)  # fmt: skip
run_control, run_codesign = CONTROL.run, CODESIGN.run


def _require_fitting(problem: EpisodeProblem) -> None:
    """Raise SceneError at the optimizer's name if it does not fit the scene."""
    scene, optimizer = problem.built.scene, optimizer_of(problem.built.scene)
    try:
        optimizer.require(problem)
        if optimizer.squares:
            others = listed(_able()) if scene.constraints else "adam, sgd, lbfgs or cma_es"
            raise UsageError(f"fits data by least squares; for an objective take {others}")
        if scene.constraints and not isinstance(optimizer, ConstrainedOptimizer):
            raise UsageError(f"does not support constraints; take {listed(_able())}, or remove `constraints`")
    except UsageError as error:
        path = f"optimizer.{optimizer.name}"
        raise SceneError([Problem(scene.where(path), path, str(error))]) from error


def _able() -> list[str]:
    """Return the optimizers that support constraints."""
    return [name for name, cls in plugins("optimizer").items() if issubclass(cls, ConstrainedOptimizer)]


def _flat(run: RunDirectory) -> bool:
    """Return whether the gradient was zero at every iteration."""
    history = read_history(run.path / "history.csv")
    if np.any(history.get(VIOLATION, 0.0)):
        return False  # without an objective only the constraints change
    norms = [column for name, column in history.items() if name.startswith("grad:")]
    largest = max((np.nanmax(np.abs(column), initial=0.0) for column in norms), default=np.inf)
    return bool(largest <= ZERO * max(1.0, np.nanmax(np.abs(history["loss"]), initial=0.0)))


def _which_iterate(run: Path, result: LearnedResult) -> Iterator[str]:
    """Yield a sentence if the values of a result are not those of the last iterate."""
    file = run / "history.csv"
    history = read_history(file) if file.is_file() else {"iteration": [], "loss": []}
    same = [k for k, loss in zip(history["iteration"], history["loss"], strict=True) if loss == result.loss]
    last = history["iteration"][-1] if same else 0
    if same and same[-1] == 0 < last:
        yield f"the result is the start: none of {last:.0f} iterates is better"
    elif same and same[-1] < last:
        yield f"the result is iterate {same[-1]:.0f}, the best of {last:.0f}"


def _ends(unknown: Designed) -> str:
    """Return how many of an unknown's numbers are at its bounds."""
    ends = {"lower": unknown.at_bounds.lower, "upper": unknown.at_bounds.upper}
    count = len(unknown.value) if isinstance(unknown.value, list) else 1
    text = ", ".join(f"{n:,} {end}" if count > 1 else end for end, n in ends.items() if n)
    return f"{text} of {count:,}" if text and count > 1 else text


def _range(value: Value) -> str:
    """Return one number, or the smallest, largest and mean of many."""
    if not isinstance(value, list):
        return number(value)
    low, high, mean = min(value), max(value), sum(value) / len(value)
    return number(low) if low == high else f"{number(low)} to {number(high)}, mean {number(mean)}"

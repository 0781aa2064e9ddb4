"""`cqrun sysid`: find a scene's unknowns from data, and say how sure the answer is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cqrun.build.model import Built
from cqrun.errors import Problem, SceneError
from cqrun.fitting.case import Case
from cqrun.fitting.cases import given_cases, made_cases, own_warnings, remarks
from cqrun.fitting.findings import write_findings
from cqrun.fitting.problem import FitProblem
from cqrun.jobs.bodies import tell_bodies
from cqrun.optimizers.base import Optimizer, Outcome
from cqrun.running.gradient_memory import gradient_plan
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import (
    Progress,
    build_and_warn,
    finished_already,
    open_run,
    raise_if_failed,
    require_extension,
    require_same_data,
    saved_scene,
    stopping,
)
from cqrun.running.threads import cores
from cqrun.running.unknowns import make_params
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import groups_of
from cqrun.store.run import RunDirectory
from cqrun.store.session import RunSession

FEW = 10
"""Up to this many unknowns, data is fitted by least squares unless the scene says otherwise."""

NEEDED = {
    "unknowns": "name what shall be found, by key path, with bounds",
    "data": "say what it is fitted to, or give an `objective` that is made small",
}
"""What a scene must have, and the advice where it is missing."""


def run_sysid(
    source: Path | str,
    overrides: Sequence[str],
    out: Path | str,
    *,
    fresh: bool = False,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> Path:
    """Identify a scene's unknowns; return the run's directory.

    Raises:
        SceneError, UsageError: bad input. RunError: the run failed. Stopped: it can be resumed.
    """
    source, out = Path(source), Path(out)
    talk = reporter or Silent()
    built = prepare(load_scene(source, overrides), talk)
    cases, n_threads = given_cases(built), cores(threads)
    with open_run(source.stem, built.scene, out, job="sysid", threads=n_threads, fresh=fresh) as run:
        if finished_already(run, talk):
            return raise_if_failed(run)
        if run.record.get("extended"):
            built = prepare(saved_scene(run), talk)
        return identify(run, built, cases, n_threads, talk)


def prepare(scene: Scene, talk: Reporter) -> Built:
    """Build a scene for sysid, its optimizer chosen.

    Raises:
        SceneError: it has no unknowns, neither data nor an objective, or too little memory for gradients.
    """
    missing = [key for key in NEEDED if not getattr(scene, key) and not (key == "data" and scene.objective)]
    if missing:
        raise SceneError([Problem(scene.where(key), key, f"sysid needs it: {NEEDED[key]}") for key in missing])
    if scene.controller is not None:
        message = (
            "sysid drives actuators by `activation` alone, and this would not act: take it out, `-o controller=null`, "
            "and give what it did as signals (a run's activation.csv has it)"
        )
        raise SceneError([Problem(scene.where("controller"), "controller", message)])
    for name in (name for name, unknown in scene.unknowns.items() if unknown.regulariser):
        path = f"unknowns.{name}.regulariser"
        message = "sysid takes none: it would pull the value towards the start, and intervals would not say so"
        raise SceneError([Problem(scene.where(path), path, message)])
    for name in scene.constraints:
        path, message = f"constraints.{name}", "sysid honours none: bound its unknowns instead"
        raise SceneError([Problem(scene.where(path), path, message)])
    scene = with_optimizer(scene)
    if scene.data is None and _optimizer(scene).squares:
        path = f"optimizer.{scene.optimizer.name}"  # type: ignore[union-attr]
        message = "fits data by least squares; for an objective take lbfgs, adam, sgd or cma_es"
        raise SceneError([Problem(scene.where(path), path, message)])
    if scene.precision == "float32" and not uses_gradients(scene) and _optimizer(scene).squares:
        path = f"optimizer.{scene.optimizer.name}"  # type: ignore[union-attr]
        message = "its Jacobian is by differences, for which `precision: float32` is too coarse: use lbfgs, or float64"
        raise SceneError([Problem(scene.where(path), path, message)])
    built = build_and_warn(scene, talk)
    if uses_gradients(built.scene):
        gradient_plan(built)
    _require_batches(built.scene)
    return built


def _require_batches(scene: Scene) -> None:
    """Refuse mini-batches larger than the data before any are made."""
    size = None if scene.optimizer is None else getattr(scene.optimizer.value, "batch_size", None)
    sequences = scene.sequences if scene.synthetic is not None else 1
    parts = sum(not spec.holdout for spec in scene.recordings.values()) or sequences
    if size is not None and size > parts:
        assert scene.optimizer is not None
        path = f"optimizer.{scene.optimizer.name}.batch_size"
        message = f"is {size}, but the data falls into {parts} parts (recordings, sequences): give at most {parts}"
        raise SceneError([Problem(scene.where(path), path, message)])


def uses_gradients(scene: Scene) -> bool:
    """Say whether a scene's optimizer asks for gradients; the Jacobian of least squares is by differences."""
    return scene.optimizer is None or _optimizer(scene).gradients


def _optimizer(scene: Scene) -> Any:
    return None if scene.optimizer is None else scene.optimizer.value


def with_optimizer(scene: Scene) -> Scene:
    """Return the scene with the optimizer it names, or the one that suits it."""
    if scene.optimizer is not None:
        return scene
    from cqrun.plugin.registry import plugins

    suited = scene.data is not None and _numbers(scene) <= FEW and scene.precision == "float64"
    name = "least_squares" if suited else "lbfgs"
    return scene.with_plugin("optimizer", plugins("optimizer")[name]())


def _numbers(scene: Scene) -> float:
    """Return how many numbers are unknown; infinitely many where each particle has one, or a field."""
    count = 0.0
    for path, unknown in scene.unknowns.items():
        count += {"body": 1, "group": len(groups_of(scene, path))}.get(unknown.per, float("inf"))
    return count


def identify(run: RunDirectory, built: Built, cases: list[Case] | None, threads: int, talk: Reporter) -> Path:
    """Run or continue the identification in a run directory."""
    scene = built.scene
    optimizer: Any = scene.optimizer.value if scene.optimizer is not None else None
    assert isinstance(optimizer, Optimizer)
    compile_kernels([built, *(case.built for case in cases or [])], talk, adjoint=uses_gradients(scene))
    run.begin(threads)
    tell_bodies(built, run, talk)
    if cases is None:
        talk.phase("making data")
        cases = made_cases(run, built)
    for warning in own_warnings(built, cases):
        talk.warn(warning)
    for sentence in remarks(cases):
        run.log(sentence)
    params = make_params(built)
    problem = FitProblem(cases, params, threads=threads)
    talk.phase(f"fitting {len(params.start)} unknowns")
    talk.begin(optimizer.max_iterations)
    session = RunSession(
        run, seed=scene.seed, blocks=params.slices, physical=params.physical, loss_unit=problem.unit,
        stop=lambda: talk.stop.asked, progress=Progress(run, talk),
    )  # fmt: skip
    outcome = optimizer.minimise(problem, session)
    return conclude(run, cases, problem, outcome, talk)


def conclude(run: RunDirectory, cases: list[Case], problem: FitProblem, outcome: Outcome, talk: Reporter) -> Path:
    """Write what was found and end the run as the outcome says."""
    if outcome.status == "stopped":
        write_findings(run, cases, problem, outcome)
        run.finish("stopped", outcome.message)
        raise talk.stop.stopped(f"{outcome.message}; `cqrun resume {run.path}` continues")
    if outcome.status != "failed":
        talk.phase("intervals, predictions, trajectory")
    problem.interrupt = stopping(run, talk)
    write_findings(run, cases, problem, outcome)
    run.finish(outcome.status, outcome.message)
    return raise_if_failed(run)


def resume_sysid(run: RunDirectory, overrides: Sequence[str], threads: int, talk: Reporter) -> Path:
    """Continue a run from its directory; overrides may only extend the optimizer's iterations."""
    require_extension(run, overrides)
    require_same_data(run)
    built = prepare(saved_scene(run, overrides), talk)
    if overrides:
        run.extend(dump(resolve(built.scene)), list(overrides))
    elif finished_already(run, talk, asked_by_scene=False):
        return raise_if_failed(run)
    return identify(run, built, given_cases(built), threads, talk)

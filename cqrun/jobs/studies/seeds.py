"""`cqrun control --seeds N`, and `codesign`: learn one scene from several seeds in parallel, and summarise the results.

Every seed is a separate run in its own process, which can be stopped and resumed like any other run; the same command
continues unfinished runs. The summary is written beside their directories:

summary-<hash>-<N>.json   each seed, and mean and 90 % interval (Student) of the loss and of every term over the seeds
summary-<hash>-<N>.csv    the same as a table

The hash is that of the scene without its seed, N is the number of seeds. Means are over the runs that meet their
constraints, or over all runs if none does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.fitting.uncertainty import interval_of_mean
from cqrun.jobs.control import CONTROL, Learning
from cqrun.jobs.studies.members import INFEASIBLE, Executor, command_of, has_ended, unfinished
from cqrun.learning.agent import Agent
from cqrun.learning.episodes import EpisodeProblem
from cqrun.learning.learned import STAGES, blown_up
from cqrun.running.cluster import PROCESSES
from cqrun.running.cost import about
from cqrun.running.fleet import Member
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import EXTENDED, optimizer_of, run_scene
from cqrun.running.tables import number, table
from cqrun.running.threads import cores
from cqrun.scene.load import dump, resolve
from cqrun.scene.paths import with_values
from cqrun.scene.schema import Scene
from cqrun.store.atomic import write_table
from cqrun.store.folder import make_below
from cqrun.store.model_file import path_of
from cqrun.store.result import LearnedResult, Stage, StageName, require_result
from cqrun.store.run import read_record
from cqrun.store.run_scene import RunScene, stem_of
from cqrun.store.study import Mean, Seed, SeedsSummary, read_seeds, write_study

MOST_SEEDS = 10_000
"""More are a slip: runs take minutes."""

CONFIDENCE = 0.9
"""Confidence of the intervals of means."""


def run_seeds(
    source: Path | str, overrides: Sequence[str], out: Path | str, *, seeds: int, fresh: bool = False,
    threads: int | None = None, job: Learning = CONTROL, jobs: int | None = None, on: str = PROCESSES,
    allow_plugins: bool = False, reporter: Reporter | None = None,
) -> tuple[Path, bool]:  # fmt: skip
    """Learn a scene's controller from seeds 0 .. seeds - 1; return the file of the summary, and whether all succeeded.

    Args:
        job: control or codesign.
        jobs: number of processes at once; the number of threads if not given.
        on: `processes`, `dask`, `dask://HOST:PORT` or `slurm`.
        threads: number of threads for all processes, which share them equally.
        allow_plugins: passed to the processes.

    Raises:
        SceneError, UsageError: bad input. Stopped: asked to stop; the same command continues.
    """
    source, out = Path(source), Path(out)
    talk, n_threads = reporter or Silent(), cores(threads)
    require_seeds(overrides, seeds, jobs)
    at_once = min(seeds, n_threads if jobs is None else jobs)
    scene = job.read(source, overrides, talk).scene
    executor = Executor(source, out, scene, job, at_once, on)
    folder = make_below(out, stem_of(source))
    problem = job.prepare(scene, 1, talk)
    scene, optimizer = problem.built.scene, optimizer_of(problem.built.scene)
    warn_if_alike(problem, seeds, talk)
    words = command_of(job.name, source, out, n_threads // at_once, fresh, allow_plugins)
    all_of_them = [member(words, source, scene, overrides, k, out, job.name) for k in range(seeds)]
    if unfinished(all_of_them):
        compile_kernels([problem.built], talk, adjoint=optimizer.gradients)
    lasts = about(problem.built.model, gradients=optimizer.gradients, each="an episode")
    executor.run(all_of_them, "seeds", f"learning from {seeds} seeds, {at_once} at once, {lasts}", talk)
    good = [s for s in all_of_them if s.failure is None]
    if talk.stop.asked and len(good) < seeds:
        raise talk.stop.stopped(f"{len(good)} of {seeds} seeds are finished; the same command continues the others")
    path = folder / f"summary-{inputs_of(source, scene, None, job.name).digest()}-{seeds}.json"
    summary = _summary(stem_of(source), all_of_them)
    write_study(path, summary)
    write_table(path.with_suffix(".csv"), _table(summary))
    return path, len(good) == seeds


def require_seeds(overrides: Sequence[str], seeds: int, jobs: int | None) -> None:
    """Raise UsageError for wrong numbers of seeds and processes, and for a seed in the overrides."""
    without = {"seeds": "the scene is learned from its own seed", "jobs": "there are as many processes as threads"}
    for name, count in (("seeds", seeds), ("jobs", jobs)):
        if count is not None and count < 1:
            raise UsageError(f"--{name} {count}: must be at least 1; without it {without[name]}")
    if seeds > MOST_SEEDS:
        raise UsageError(f"--seeds {seeds}: must be at most {MOST_SEEDS:,}: each is a run of its own")
    for override in overrides:
        if override.partition("=")[0].strip() == "seed":
            raise UsageError(f"-o {override}: --seeds gives every run a seed of its own: remove one of the two")


def warn_if_alike(problem: EpisodeProblem, seeds: int, talk: Reporter) -> None:
    """Warn if seeds have no effect."""
    if seeds > 1 and not optimizer_of(problem.built.scene).draws and starts_alike(problem):
        talk.warn(
            f"--seeds {seeds}: nothing in this scene depends on its seed, so all runs will be the same; give the "
            "controller a random start, such as open_loop's `noise`"
        )


def starts_alike(problem: EpisodeProblem) -> bool:
    """Return whether another seed of the scene gives the same start."""
    built = problem.built
    other = EpisodeProblem(Agent(replace(built, scene=with_values(built.scene, {"seed": built.scene.seed + 1}))))
    return bool(np.array_equal(other.start, problem.start))


def member(
    words: Sequence[str], source: Path, scene: Scene, overrides: Sequence[str], seed: int, out: Path, job: str
) -> Member:
    """Return the run of one seed; `scene` is the resolved scene with the overrides."""
    optimizer: Any = scene.optimizer.value if scene.optimizer is not None else None
    options = [word for override in (*overrides, f"seed={seed}") for word in ("-o", override)]
    run = out / stem_of(source) / inputs_of(source, scene, seed, job).digest()
    return Member(f"seed {seed}", run, [*words, *options], optimizer.max_iterations)


def inputs_of(source: Path, scene: Scene, seed: int | None, job: str) -> RunScene:
    """Return the inputs whose hash names the run of a seed, or without a seed the summary."""
    if seed is not None:
        return run_scene(stem_of(source), with_values(scene, {"seed": seed}), job=job, with_data=False)
    unseeded = {key: value for key, value in resolve(scene).items() if key != "seed"}
    return replace(run_scene(stem_of(source), scene, job=job, with_data=False), resolved=dump(unseeded))


# --- the summary --------------------------------------------------------------------------------------------------


def interval(values: Sequence[float]) -> Mean:
    """Return the mean of values and its 90 % interval by Student's distribution; one value has no interval."""
    x = np.array(values, float)
    if len(x) == 1:
        return Mean(mean=float(x[0]), low=None, high=None)
    mean, half = map(float, interval_of_mean(x, CONFIDENCE))
    return Mean(mean=mean, low=mean - half, high=mean + half)


def _summary(stem: str, seeds: Sequence[Member]) -> SeedsSummary:
    """Return every seed's result, and means with intervals over the seeds that succeeded."""
    results = {k: require_result(member.run, LearnedResult) for k, member in enumerate(seeds) if has_ended(member)}
    good = [result for result in results.values() if result.status != INFEASIBLE] or list(results.values())
    stages = [name for name in STAGES if good and all(name in result.stages() for result in good)]
    return SeedsSummary(
        scene=stem,
        confidence=CONFIDENCE,
        seeds={
            str(k): _seed(member, results[k], stages)
            if k in results
            else Seed(run=str(member.run), status="failed", reason=member.failure)
            for k, member in enumerate(seeds)
        },
        all={
            stage: {
                name: interval([_numbers(result.stages()[stage])[name] for result in good])
                for name in _numbers(good[0].stages()[stage])
            }
            for stage in stages
        },
    )


def _seed(member: Member, result: LearnedResult, stages: Sequence[StageName]) -> Seed:
    """Return the result of one seed's run."""
    numbers = {name: _numbers(result.stages()[name]) for name in stages}
    return Seed(
        run=str(member.run), status=result.status, iterations=result.iterations, blew_up=list(blown_up(result)),
        extended=bool(read_record(member.run).get("extended")),
        start=numbers.get("start"), trained=numbers.get("trained"), unseen=numbers.get("unseen"),
    )  # fmt: skip


def _numbers(stage: Stage) -> dict[str, float]:
    """Return the terms of a stage, and its loss as `loss`."""
    return {**stage.terms, "loss": stage.loss}


def _table(summary: SeedsSummary) -> Iterator[list[object]]:
    """Yield one row per seed, then rows of the mean and of both ends of its interval."""
    columns = [(stage, name) for stage, numbers in summary.all.items() for name in numbers]
    yield ["seed", "run", "status", "iterations", *(f"{stage}:{name}" for stage, name in columns)]
    for seed, entry in summary.seeds.items():
        numbers = [(getattr(entry, stage) or {}).get(name) for stage, name in columns]
        yield [seed, entry.run, entry.status, entry.iterations, *numbers]
    for end in ("mean", "low", "high"):
        yield [end, None, None, None, *(getattr(summary.all[stage][name], end) for stage, name in columns)]


def summary_lines(path: Path) -> list[str]:
    """Return a summary as lines for a terminal."""
    summary = read_seeds(path)
    seeds = summary.seeds.items()
    ended = [entry for _, entry in seeds if entry.status != "failed"]
    good = [entry for entry in ended if entry.status != INFEASIBLE] or ended
    means = f"mean and {summary.confidence:.0%} interval over"
    lines = [f"{len(good)} of {len(seeds)} seeds learned; {means} them", ""]
    if good and all(entry.status == INFEASIBLE for entry in good):
        lines = [f"0 of {len(seeds)} seeds meet their constraints; {means} all of them", ""]
    if stages := list(summary.all):
        head = ("term", *(STAGES[stage] for stage in stages))
        names = list(summary.all[stages[0]])
        lines += table(head, [(name, *(shown(summary.all[stage][name]) for stage in stages)) for name in names])
    lines += [f"seed {k} does not meet its constraints" for k, entry in seeds if entry.status == INFEASIBLE]
    lines += [
        f"seed {k} failed: {path_of(entry.run)}: {entry.reason}" for k, entry in seeds if entry.status == "failed"
    ]
    lines += [f"warning: seed {k}: {EXTENDED}" for k, entry in seeds if entry.extended]
    lines += [f"seed {k}, {sentence}" for k, entry in seeds for sentence in entry.blew_up or []]
    spread = summary.all.get("trained", {}).get("loss")
    if len(good) > 1 and spread is not None and spread.low == spread.high:
        lines.append("note: all seeds have the same result: nothing in this scene depends on its seed")
    if ended:
        lines += ["", "to draw them together: cqrun plot " + " ".join(str(path_of(entry.run)) for entry in ended)]
    return [*lines, f"summary: {path}"]


def shown(mean: Mean) -> str:
    """Return a mean with its interval, if it has one."""
    assert mean.mean is not None
    if mean.low is None or mean.high is None:
        return number(mean.mean)
    return f"{number(mean.mean)} ({number(mean.low)} to {number(mean.high)})"

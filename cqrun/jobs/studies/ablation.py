"""`cqrun codesign --ablate`: measure how much each group of unknowns of a design helps, compared with control alone.

Unknowns of one kind (the last name of their paths, such as `youngs_modulus`) are a group. A variant frees some groups
and fixes the others at their start values. Up to three groups give all combinations, as in CQ2; more give none, each
alone, and all. Every variant is learned from the same seeds. If several learning rates are given, each variant uses the
best one with seed 0. Every run is a separate run that can be resumed; the same command continues the study.

ablation-<hash>-<N>.json   per variant: rate, runs, mean and 90 % interval of every term; gains over control; effects
ablation-<hash>-<N>.csv    the variants as a table
ablation-<hash>-<N>.png    the compared term against the iteration, and its final values

The effect of a group is the change of the compared term when the group is freed, as the mean over all variants without
it, seed by seed (a factorial design: G. Box, J. Hunter, W. Hunter: Statistics for experimenters, 2005, chapter 5). A
positive gain is an improvement. Variants with a run that fails or violates its constraints have neither.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.errors import RunError
from cqrun.explain import listed
from cqrun.jobs import control
from cqrun.jobs.studies.members import INFEASIBLE, Executor, command_of, has_ended, unfinished
from cqrun.jobs.studies.seeds import CONFIDENCE, inputs_of, interval, member, require_seeds, shown, warn_if_alike
from cqrun.jobs.studies.variants import CONTROL, Variant, rate_overrides, variants_of
from cqrun.optimizers.constrained import ranked
from cqrun.plugin.contract import Array
from cqrun.running.cluster import PROCESSES
from cqrun.running.fleet import Member
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import optimizer_of
from cqrun.running.tables import table
from cqrun.running.threads import cores
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene
from cqrun.store.atomic import write_table
from cqrun.store.folder import RECORD, make_below
from cqrun.store.result import LearnedResult, Stage, require_result
from cqrun.store.run import read_record
from cqrun.store.run_scene import RunScene, stem_of
from cqrun.store.study import Ablation, Mean, VariantRuns, read_ablation, write_study

NOTHING = Mean(mean=None, low=None, high=None)
"""The values of a variant whose runs have all failed."""


def run_ablation(
    source: Path | str, overrides: Sequence[str], out: Path | str, *, seeds: int, fresh: bool = False,
    threads: int | None = None, rates: Sequence[float] = (), jobs: int | None = None, on: str = PROCESSES,
    allow_plugins: bool = False, reporter: Reporter | None = None,
) -> tuple[Path, bool]:  # fmt: skip
    """Compare a scene's variants; return the file of the comparison, and whether all runs succeeded.

    Args:
        seeds: number of seeds for each variant.
        rates: learning rates to try with each variant; only the scene's own if empty.
        jobs: number of processes at once; the number of threads if not given.
        on: `processes`, `dask`, `dask://HOST:PORT` or `slurm`.
        threads: number of threads for all processes, which share them equally.

    Raises:
        SceneError, UsageError: bad input. RunError: a run was killed. Stopped: asked; the same command continues.
    """
    source, out = Path(source), Path(out)
    talk, n_threads = reporter or Silent(), cores(threads)
    require_seeds(overrides, seeds, jobs)
    scene = load_scene(source, overrides)
    variants, tried = variants_of(scene), rate_overrides(scene, rates)
    at_once = min(n_threads if jobs is None else jobs, len(variants) * max(seeds, len(tried)))
    executor = Executor(source, out, scene, control.CODESIGN, at_once, on)
    whole = control.CODESIGN.prepare(scene, 1, Silent())
    warn_if_alike(whole, seeds, talk)
    folder = make_below(out, stem_of(source))
    # `auto` depends on the bounds of the free unknowns; variants with different time steps could not be compared
    same_step = [f"time.substeps={whole.built.model.substeps}"] if scene.time.substeps == "auto" else []
    make = _Members(source, [*overrides, *same_step], out, max(1, n_threads // at_once), allow_plugins, talk)
    best: dict[str, str | None] = {v.name: tried[0] for v in variants}
    searched: dict[str, dict[str, float | None]] = {}
    if len(tried) > 1:
        trials = {(v.name, rate): make(v, rate, [0], fresh)[0] for v in variants for rate in tried}
        doing = f"trying {len(tried)} learning rates with {len(variants)} variants, {at_once} at once"
        _run(executor, list(trials.values()), "trials", doing, talk)
        for v in variants:
            best[v.name], searched[v.name] = _best_rate(scene, {rate: trials[v.name, rate] for rate in tried})
    runs = {}
    for v in variants:  # the search, if there was one, has already run seed 0 again
        first = make(v, best[v.name], [0], fresh and not searched)
        runs[v.name] = first + (make(v, best[v.name], range(1, seeds), fresh) if seeds > 1 else [])
    everyone = [run for of_seed in zip(*runs.values(), strict=True) for run in of_seed]  # so a stop leaves whole seeds
    doing = f"learning {len(variants)} variants from {seeds} seeds, {at_once} at once"
    _run(executor, everyone, "runs", doing, talk, len(variants))
    result = summary(stem_of(source), scene, variants, runs)
    for v in variants:
        result.variants[v.name].rate = (best[v.name] or "").partition("=")[2] or None
        result.variants[v.name].searched = searched.get(v.name)
    name = _name(inputs_of(source, scene, None, control.CODESIGN.name), rates)
    path = folder / f"ablation-{name}-{seeds}.json"
    write_study(path, result)
    write_table(path.with_suffix(".csv"), _table(result))
    return path, all(map(has_ended, everyone)) and not _none_is_feasible(result)


def _name(inputs: RunScene, rates: Sequence[float]) -> str:
    """Return the hash of the scene and of the rates."""
    digest = inputs.digest()
    return hashlib.sha256(f"{digest}\0{[*rates]}".encode()).hexdigest()[:12] if rates else digest


@dataclass(frozen=True)
class _Members:
    """Makes the runs of variants as processes of the command line."""

    source: Path
    overrides: Sequence[str]
    out: Path
    threads: int
    allow_plugins: bool
    talk: Reporter

    def __call__(self, variant: Variant, rate: str | None, seeds: Sequence[int], fresh: bool) -> list[Member]:
        overrides = [*self.overrides, *variant.overrides, *([rate] if rate else [])]
        problem = variant.job.prepare(load_scene(self.source, overrides), 1, self.talk)
        words = command_of(variant.job.name, self.source, self.out, self.threads, fresh, self.allow_plugins)
        scene = problem.built.scene
        members = [member(words, self.source, scene, overrides, k, self.out, variant.job.name) for k in seeds]
        for run in members:
            run.name = f"{variant.name}, {run.name}{f' with {rate}' if rate else ''}"
        if unfinished(members):
            compile_kernels([problem.built], self.talk, adjoint=optimizer_of(scene).gradients)
        return members


def _best_rate(scene: Scene, trials: Mapping[str | None, Member]) -> tuple[str | None, dict[str, float | None]]:
    """Return the override of the rate with the best trial, and every rate's loss, or None if it failed."""
    results = {rate: require_result(trial.run, LearnedResult) for rate, trial in trials.items() if has_ended(trial)}
    losses = {str(rate).partition("=")[2]: _after(results[rate]).loss if rate in results else None for rate in trials}
    ranks = {rate: _rank(scene, result) for rate, result in results.items()}
    return min(ranks, key=ranks.__getitem__, default=next(iter(trials))), losses


def _run(
    executor: Executor, members: Sequence[Member], what: str, doing: str, talk: Reporter, of_seed: int = 0
) -> None:
    """Run all members; raise RunError if one was killed, but not if one blew up, which is a result.

    Args:
        what, doing: as `Executor.run`.
        of_seed: number of consecutive members with the same seed; 0 if they are in another order.
    """
    executor.run(members, what, doing, talk)
    good = [m for m in members if has_ended(m)]
    if talk.stop.asked and len(good) < len(members):
        whole = list(itertools.takewhile(lambda m: has_ended(m) or _blew_up(m), members))
        seeds = len(whole) // of_seed if of_seed else 0
        now = f"; with --seeds {seeds} it compares the finished runs" if seeds else ""
        raise talk.stop.stopped(f"{len(good)} of {len(members)} {what} are finished; the same command continues{now}")
    bad = [m for m in members if not has_ended(m) and not _blew_up(m)]
    if bad:
        first = f"{bad[0].name} ({bad[0].run}): {bad[0].failure}"
        raise RunError(f"{len(bad)} of {len(members)} {what} failed; {first}")


def _blew_up(member: Member) -> bool:
    """Return whether a run has recorded that it failed, which is a result; a killed process records nothing."""
    return (member.run / RECORD).exists() and read_record(member.run)["status"] == "failed"


def _after(result: LearnedResult) -> Stage:
    """Return the stage after the training of a run that has ended."""
    assert result.trained is not None
    return result.trained


def _rank(scene: Scene, result: LearnedResult) -> tuple[float, float, float]:
    """Return the rank of a result, by which optimizers also order points."""
    assert scene.optimizer is not None
    tolerance = getattr(scene.optimizer.value, "constraint_tolerance", 0.0)
    constraints = result.constraints.items() if result.status == INFEASIBLE else ()
    excess = np.array([value.violation / scene.constraints[name].scale for name, value in constraints])
    return ranked(excess, _after(result).loss, tolerance)


# --- the comparison -----------------------------------------------------------------------------------------------


def summary(stem: str, scene: Scene, variants: Sequence[Variant], runs: dict[str, list[Member]]) -> Ablation:
    """Return every variant's terms and gain over control alone, and the effects of the groups on the first term."""
    results = {
        v.name: [require_result(run.run, LearnedResult) for run in runs[v.name] if has_ended(run)] for v in variants
    }
    compared = next(iter(scene.objective))
    sense = scene.objective[compared].value.sense  # type: ignore[attr-defined]
    feasible = {name: [r for r in each if r.status != INFEASIBLE] for name, each in results.items()}
    met = {name: len(each) for name, each in feasible.items()}
    shown = {name: each or results[name] for name, each in feasible.items()}
    values = {
        name: [_after(result).terms[compared] for result in each]
        for name, each in results.items()
        if met[name] == len(runs[name])
    }
    return Ablation(
        scene=stem,
        confidence=CONFIDENCE,
        compared=compared,
        better="greater" if sense < 0 else "smaller",
        variants={
            v.name: VariantRuns(
                free=list(v.groups),
                runs=[str(run.run) for run in runs[v.name]],
                failed={run.name: f"{run.run}: {run.failure}" for run in runs[v.name] if not has_ended(run)},
                feasible=met[v.name] if scene.constraints else None,
                terms=_means(shown[v.name], scene.objective, lambda r, name: _after(r).terms[name]),
                constraints=_means(results[v.name], scene.constraints, lambda r, name: r.constraints[name].value),
                gain=_gain(values.get(v.name), values.get(CONTROL), sense),
            )
            for v in variants
        },
        effects={
            group: interval(added.tolist())
            for group, added in effects(
                {frozenset(v.groups): np.array(values[v.name]) for v in variants if v.name in values}
            ).items()
        },
    )


def _means(
    results: Sequence[LearnedResult], names: Iterable[str], value: Callable[[LearnedResult, str], float]
) -> dict[str, Mean]:
    """Return means over the results, without values if there are no results."""
    return {name: interval([value(result, name) for result in results]) if results else NOTHING for name in names}


def _gain(values: Sequence[float] | None, control: Sequence[float] | None, sense: float) -> Mean | None:
    """Return the improvement seed by seed, relative to the mean of control; None if that mean is zero."""
    if values is None or control is None or float(np.mean(control)) == 0.0:
        return None
    base = abs(float(np.mean(control)))
    better = -1.0 if sense < 0 else 1.0
    return interval([better * (alone - value) / base for value, alone in zip(values, control, strict=True)])


def effects(by_free: Mapping[frozenset[str], Array]) -> dict[str, Array]:
    """Return the effect (S,) of each group, as the mean over pairs of variants that differ only in this group.

    Args:
        by_free: values (S,), one per seed, by the free groups of a variant.

    A group without such a pair is missing in the result.
    """
    mean_effects = {}
    for group in dict.fromkeys(group for free in by_free for group in sorted(free)):
        added = [by_free[free | {group}] - without for free, without in by_free.items()
                 if group not in free and free | {group} in by_free]  # fmt: skip
        if added:
            mean_effects[group] = np.asarray(np.mean(added, axis=0))
    return mean_effects


def _table(result: Ablation) -> Iterator[list[object]]:
    """Yield one row per variant: mean and interval of every term, every constraint and the gain."""
    for k, (name, entry) in enumerate(result.variants.items()):
        constraints = {f"constraint:{constraint}": mean for constraint, mean in entry.constraints.items()}
        numbers = {**entry.terms, **constraints, "gain": entry.gain or NOTHING}
        if k == 0:
            columns = [f"{column}:{end}" for column in numbers for end in ("mean", "low", "high")]
            yield ["variant", "rate", "seeds", *(["feasible"] if constraints else []), *columns]
        ends = [end for n in numbers.values() for end in (n.mean, n.low, n.high)]
        yield [name, entry.rate, len(entry.runs), *([entry.feasible] if constraints else []), *ends]


def _none_is_feasible(result: Ablation) -> bool:
    """Return whether there are constraints that no run of any variant meets."""
    counts = [entry.feasible for entry in result.variants.values()]
    return not any(counts) and any(count is not None for count in counts)


def ablation_lines(path: Path) -> list[str]:
    """Return an ablation as lines for a terminal."""
    result = read_ablation(path)
    compared, variants = result.compared, result.variants
    seeds = len(next(iter(variants.values())).runs)
    rows = [
        (
            name,
            entry.rate or "",
            "failed" if entry.terms[compared].mean is None else shown(entry.terms[compared]),
            "" if entry.gain is None or name == CONTROL else f"{entry.gain.mean:+.1%}",
            *([] if entry.feasible is None else [f"{entry.feasible} of {seeds}"]),
        )
        for name, entry in variants.items()
    ]
    head, sure = ("free", "rate", compared, "gain", "feasible")[: len(rows[0])], f"{result.confidence:.0%}"
    effects = sorted(result.effects.items(), key=lambda item: -abs(item[1].mean or 0.0))
    failed = {name: [rate for rate, loss in (entry.searched or {}).items() if loss is None]
              for name, entry in variants.items()}  # fmt: skip
    return [
        f"{len(variants)} variants from {'one seed' if seeds == 1 else f'{seeds} seeds; mean and {sure} interval'}; "
        f"{result.better} is better",
        "",
        *table(head, rows),
        *(f"note: {name} failed with rate {listed(rates)}" for name, rates in failed.items() if rates),
        *(f"{name} failed: {why.partition(';')[0]}" for e in variants.values() for name, why in e.failed.items()),
        *(["no run of any variant meets the constraints"] if _none_is_feasible(result) else []),
        *(["", *table(("freeing it adds", compared), [(name, shown(of)) for name, of in effects])] if effects else []),
        f"ablation: {path}",
    ]

"""`cqrun codesign --ablate`: which unknowns of a design help, and by how much, against learning the controller alone.

Unknowns of one kind (the last name of their paths, such as `youngs_modulus`) are a group. A variant frees some groups
and keeps the others at their starts: all combinations of up to three groups, as CQ2 does; of more, none, each alone,
and all. Every variant is learned from the same seeds, with the learning rate that serves it best among those that are
given, found with seed 0. Every run is one of its own that can be resumed; the same command goes on.

ablation-<hash>-<N>.json   per variant: rate, runs, mean and 90 % interval of every term; gains over control; effects
ablation-<hash>-<N>.csv    the variants as a table
ablation-<hash>-<N>.png    the compared term against the iteration, and where it ended

The effect of a group is what freeing it adds to the compared term, in the mean over all variants without it, seed by
seed (a factorial design: G. Box, J. Hunter, W. Hunter: Statistics for experimenters, 2005, chapter 5). A gain is
positive where a variant is better. Variants that fail, or do not meet their constraints, from any seed have neither.
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
from cqrun.jobs.studies.seeds import (
    CONFIDENCE,
    INFEASIBLE,
    command_of,
    has_ended,
    inputs_of,
    interval,
    member,
    require_seeds,
    shown,
    warn_if_alike,
)
from cqrun.jobs.studies.variants import CONTROL, Variant, rate_overrides, variants_of
from cqrun.optimizers.constrained import ranked
from cqrun.plugin.contract import Array
from cqrun.running.fleet import Member, run_fleet
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import optimizer_of
from cqrun.running.tables import table
from cqrun.running.threads import cores
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene
from cqrun.store.atomic import write_table
from cqrun.store.result import LearnedResult, Stage, require_result
from cqrun.store.run import RECORD, RunScene, read_record, stem_of
from cqrun.store.study import Ablation, Mean, VariantRuns, read_ablation, write_study

NOTHING = Mean(mean=None, low=None, high=None)
"""What a variant is of which every run has failed."""


def run_ablation(
    source: Path | str,
    overrides: Sequence[str],
    out: Path | str,
    *,
    seeds: int,
    fresh: bool = False,
    threads: int | None = None,
    rates: Sequence[float] = (),
    jobs: int | None = None,
    allow_plugins: bool = False,
    reporter: Reporter | None = None,
) -> tuple[Path, bool]:
    """Compare a scene's variants; return the file that says how, and whether all runs went well.

    Args:
        seeds: how many each is learned from.
        rates: learning rates that each is tried with; the scene's own alone if empty.
        jobs: how many processes at once; as many as there are threads if absent.
        threads: all together; every process has an equal share.

    Raises:
        SceneError, UsageError: bad input. Stopped: asked to stop; the same command goes on. RunError: a run was killed.
    """
    source, out = Path(source), Path(out)
    talk, n_threads = reporter or Silent(), cores(threads)
    require_seeds(overrides, seeds, jobs)
    scene = load_scene(source, overrides)
    variants, tried = variants_of(scene), rate_overrides(scene, rates)
    whole = control.CODESIGN.prepare(scene, 1, Silent())
    warn_if_alike(whole, seeds, talk)
    # `auto` follows from the bounds of what is free: variants of other time steps would not be comparable
    same_step = [f"time.substeps={whole.built.model.substeps}"] if scene.time.substeps == "auto" else []
    at_once = min(n_threads if jobs is None else jobs, len(variants) * max(seeds, len(tried)))
    make = _Members(source, [*overrides, *same_step], out, max(1, n_threads // at_once), allow_plugins, talk)
    best: dict[str, str | None] = {v.name: tried[0] for v in variants}
    searched: dict[str, dict[str, float | None]] = {}
    if len(tried) > 1:
        trials = {(v.name, rate): make(v, rate, [0], fresh)[0] for v in variants for rate in tried}
        talk.phase(f"trying {len(tried)} learning rates with {len(variants)} variants, {at_once} at once")
        _run(list(trials.values()), at_once, "trials", talk)
        for v in variants:
            best[v.name], searched[v.name] = _best_rate(scene, {rate: trials[v.name, rate] for rate in tried})
    runs = {}
    for v in variants:  # seed 0 has been learned anew by the search, if there was one
        first = make(v, best[v.name], [0], fresh and not searched)
        runs[v.name] = first + (make(v, best[v.name], range(1, seeds), fresh) if seeds > 1 else [])
    talk.phase(f"learning {len(variants)} variants from {seeds} seeds, {at_once} at once")
    everyone = [run for of_seed in zip(*runs.values(), strict=True) for run in of_seed]  # stopped, most can be compared
    _run(everyone, at_once, "runs", talk, len(variants))
    result = summary(stem_of(source), scene, variants, runs)
    for v in variants:
        result.variants[v.name].rate = (best[v.name] or "").partition("=")[2] or None
        result.variants[v.name].searched = searched.get(v.name)
    path = (
        out
        / stem_of(source)
        / f"ablation-{_name(inputs_of(source, scene, None, control.CODESIGN.name), rates)}-{seeds}.json"
    )
    write_study(path, result)
    write_table(path.with_suffix(".csv"), _table(result))
    return path, all(map(has_ended, everyone)) and not _none_is_feasible(result)


def _name(inputs: RunScene, rates: Sequence[float]) -> str:
    """Return the hash of what is compared: of the scene, and of the rates that are tried."""
    digest = inputs.digest()
    return hashlib.sha256(f"{digest}\0{[*rates]}".encode()).hexdigest()[:12] if rates else digest


@dataclass(frozen=True)
class _Members:
    """Makes the runs of variants, as processes of the command."""

    source: Path
    overrides: Sequence[str]
    out: Path
    threads: int
    allow_plugins: bool
    talk: Reporter

    def __call__(self, variant: Variant, rate: str | None, seeds: Sequence[int], fresh: bool) -> list[Member]:
        own = [*self.overrides, *variant.overrides, *([rate] if rate else [])]
        problem = variant.job.prepare(load_scene(self.source, own), 1, self.talk)
        compile_kernels([problem.built], self.talk, adjoint=optimizer_of(problem.built.scene).gradients)
        words = command_of(variant.job.name, self.source, self.out, self.threads, fresh, self.allow_plugins)
        scene = problem.built.scene
        made = [member(words, self.source, scene, own, seed, self.out, variant.job.name) for seed in seeds]
        for run in made:
            run.name = f"{variant.name}, {run.name}{f' with {rate}' if rate else ''}"
        return made


def _best_rate(scene: Scene, trials: Mapping[str | None, Member]) -> tuple[str | None, dict[str, float | None]]:
    """Return the override of the rate whose trial ended best, and every rate's loss, None where it failed."""
    found = {rate: require_result(trial.run, LearnedResult) for rate, trial in trials.items() if has_ended(trial)}
    losses = {str(rate).partition("=")[2]: _after(found[rate]).loss if rate in found else None for rate in trials}
    ranks = {rate: _rank(scene, result) for rate, result in found.items()}
    return min(ranks, key=ranks.__getitem__, default=next(iter(trials))), losses


def _run(members: Sequence[Member], at_once: int, what: str, talk: Reporter, of_seed: int = 0) -> None:
    """Run all; that one of them blew up is a result, that it was killed is not.

    Args:
        of_seed: how many of them in turn are of one seed; 0 if that is not so.
    """
    run_fleet(members, at_once, what, talk)
    good = [m for m in members if has_ended(m)]
    if talk.stop.asked and len(good) < len(members):
        whole = list(itertools.takewhile(lambda m: has_ended(m) or _blew_up(m), members))
        seeds = len(whole) // of_seed if of_seed else 0
        now = f"; with --seeds {seeds} it compares what there is" if seeds else ""
        raise talk.stop.stopped(f"{len(good)} of {len(members)} {what} are finished; the same command continues{now}")
    bad = [m for m in members if not has_ended(m) and not _blew_up(m)]
    if bad:
        raise RunError(f"{len(bad)} of {len(members)} {what} failed; {bad[0].name}: {bad[0].failure}")


def _blew_up(member: Member) -> bool:
    """Say whether a run itself found that it fails, which is a result too; a process that was killed has none."""
    return (member.run / RECORD).exists() and read_record(member.run)["status"] == "failed"


def _after(result: LearnedResult) -> Stage:
    """Return the episodes after the training, which a run that has ended has."""
    assert result.trained is not None
    return result.trained


def _rank(scene: Scene, result: LearnedResult) -> tuple[float, float, float]:
    """Return what orders results, as the optimizers order points."""
    assert scene.optimizer is not None
    tolerance = getattr(scene.optimizer.value, "constraint_tolerance", 0.0)
    held = result.constraints.items() if result.status == INFEASIBLE else ()
    excess = np.array([found.violation / scene.constraints[name].scale for name, found in held])
    return ranked(excess, _after(result).loss, tolerance)


# --- what they say ------------------------------------------------------------------------------------------------


def summary(stem: str, scene: Scene, variants: Sequence[Variant], runs: dict[str, list[Member]]) -> Ablation:
    """Return every variant's terms, gains over control alone, and effects of the groups on the first term."""
    results = {
        v.name: [require_result(run.run, LearnedResult) for run in runs[v.name] if has_ended(run)] for v in variants
    }
    compared = next(iter(scene.objective))
    sense = scene.objective[compared].value.sense  # type: ignore[attr-defined]
    feasible = {name: [one for one in each if one.status != INFEASIBLE] for name, each in results.items()}
    met = {name: len(each) for name, each in feasible.items()}
    shown = {name: each or results[name] for name, each in feasible.items()}
    values = {
        name: [_after(one).terms[compared] for one in each]
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
                failed={run.name: str(run.failure) for run in runs[v.name] if not has_ended(run)},
                feasible=met[v.name] if scene.constraints else None,
                terms=_means(shown[v.name], scene.objective, lambda one, name: _after(one).terms[name]),
                constraints=_means(results[v.name], scene.constraints, lambda one, name: one.constraints[name].value),
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
    """Return means over the runs that have a result; of nothing, nothing."""
    return {name: interval([value(one, name) for one in results]) if results else NOTHING for name in names}


def _gain(values: Sequence[float] | None, control: Sequence[float] | None, sense: float) -> Mean | None:
    """Return by which part of control's mean the values are better, seed by seed; None where that is nought."""
    if values is None or control is None or float(np.mean(control)) == 0.0:
        return None
    base = abs(float(np.mean(control)))
    better = -1.0 if sense < 0 else 1.0
    return interval([better * (alone - value) / base for value, alone in zip(values, control, strict=True)])


def effects(by_free: Mapping[frozenset[str], Array]) -> dict[str, Array]:
    """Return what freeing each group adds, in the mean over variants that differ in it alone.

    Args:
        by_free: values (S,), one a seed, of variants by the groups that are free in them.

    Returns:
        By group (S,); nothing of a group without two variants that differ in it alone.
    """
    found = {}
    for group in dict.fromkeys(group for free in by_free for group in sorted(free)):
        added = [by_free[free | {group}] - without for free, without in by_free.items()
                 if group not in free and free | {group} in by_free]  # fmt: skip
        if added:
            found[group] = np.asarray(np.mean(added, axis=0))
    return found


def _table(result: Ablation) -> Iterator[list[object]]:
    """Yield a row a variant: mean and interval of every term, of every constraint and of the gain."""
    for k, (name, entry) in enumerate(result.variants.items()):
        held = {f"constraint:{constraint}": found for constraint, found in entry.constraints.items()}
        numbers = {**entry.terms, **held, "gain": entry.gain or NOTHING}
        if k == 0:
            columns = [f"{column}:{end}" for column in numbers for end in ("mean", "low", "high")]
            yield ["variant", "rate", "seeds", *(["feasible"] if held else []), *columns]
        ends = [end for n in numbers.values() for end in (n.mean, n.low, n.high)]
        yield [name, entry.rate, len(entry.runs), *([entry.feasible] if held else []), *ends]


def _none_is_feasible(result: Ablation) -> bool:
    """Say whether there are constraints, and no run of any variant meets them."""
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
    lost = {name: [rate for rate, loss in (entry.searched or {}).items() if loss is None]
            for name, entry in variants.items()}  # fmt: skip
    return [
        f"{len(variants)} variants from {'one seed' if seeds == 1 else f'{seeds} seeds; mean and {sure} interval'}; "
        f"{result.better} is better",
        "",
        *table(head, rows),
        *(f"note: {name} failed with rate {listed(rates)}" for name, rates in lost.items() if rates),
        *(f"{name} failed: {why.partition(';')[0]}" for e in variants.values() for name, why in e.failed.items()),
        *(["no run of any variant meets the constraints"] if _none_is_feasible(result) else []),
        *(["", *table(("freeing it adds", compared), [(name, shown(of)) for name, of in effects])] if effects else []),
        f"ablation: {path}",
    ]

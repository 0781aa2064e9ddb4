"""Figures of the gradient beside learners without it, at the same task (CQ1 Fig 7 and V-B).

An episode is one rollout. PPO is that of stable-baselines3 with its defaults: networks of 64 x 64, normalised
observations and rewards. Its reward is the decrease of the loss, with the distance in place of its square. CMA-ES uses
the scene's own controller. PPO needs the extra `rl`; without it the committed curves are shown.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.families.histories import first_below, moving_mean, runs_below
from benchmarks.papers.families.train_ppo import checkpoint_of, episodes_in
from benchmarks.papers.figure import Figure, Folders, Judgement, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.measurement import Measurement
from benchmarks.papers.machinery.process import STOPPED, run_command
from benchmarks.papers.machinery.runs import SCENES, Runs
from benchmarks.papers.machinery.task import REMARK, Task, TaskError
from cqrun.figures.style import COLOURS, new_figure, titled
from cqrun.plugin.contract import Array
from cqrun.store.atomic import write_json, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

COMMITTED = Path(__file__).parents[1] / "ppo"
"""Committed curves of PPO: SIZE/SCENE-SEED.csv. The first line has the fingerprint of the task that they belong to."""

NOT_TRAINED = "committed curves, the time of their training not counted"
"""The remark on PPO where it was not trained."""

GRADIENT, CMA, PPO = "gradient", "CMA-ES", "PPO"
POPULATION = 16
"""Of a generation of CMA-ES."""


class Learners(Figure):
    """The measure against the episode, for the gradient, CMA-ES and PPO."""

    scene: ClassVar[str]  # below scenes/
    label: ClassVar[str]  # of the measure, a function of the loss
    distance: ClassVar[bool] = True  # whether the measure is the root of the loss
    small: ClassVar[tuple[str, ...]]  # overrides of the scene at quick size
    optimizer: ClassVar[str]  # of the scene
    episodes: ClassVar[dict[str, dict[Size, int]]]  # of each learner
    seeds: ClassVar[dict[Size, int]] = {Size.QUICK: 1, Size.PAPER: 10}  # of the gradient
    trials: ClassVar[dict[Size, int]] = {Size.QUICK: 1, Size.PAPER: 3}  # of CMA-ES and PPO
    minutes: ClassVar[dict[str, dict[Size, float]]]  # of each learner
    thresholds: ClassVar[tuple[float, ...]]  # of the measure; the verdict counts the episodes to them
    windows: ClassVar[dict[str, int]]  # of each learner: episodes over which the measure is averaged
    printed: ClassVar[dict[str, Sequence[tuple[float, float]]]] = {}  # learner -> points (episode, measure)
    squared: ClassVar[str] = (
        "objective.tip.reach.squared=false"  # makes PPO's reward a distance; empty if none is needed
    )

    @property
    def stem(self) -> str:
        """The scene's name."""
        return self.scene.rpartition("/")[2]

    def overrides(self, size: Size) -> tuple[str, ...]:
        """Return the scene's overrides at a size."""
        return self.small if size is Size.QUICK else ()

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return a task for each learner."""
        overrides, minutes = self.overrides(size), {method: of[size] for method, of in self.minutes.items()}
        iterations = f"optimizer.{self.optimizer}.max_iterations={self.episodes[GRADIENT][size]}"
        gradient = (*overrides, iterations)
        tasks: list[Task] = [
            Runs(self.stem, minutes[GRADIENT], "control", self.scene, gradient, self.seeds[size])
        ]  # fmt: skip
        if CMA in self.episodes:
            generations = self.episodes[CMA][size] // POPULATION
            cma = (*overrides, f"optimizer={{cma_es: {{max_iterations: {generations}, population: {POPULATION}}}}}")
            tasks.append(Runs(f"{self.stem}_cma_es", minutes[CMA], "control", self.scene, cma, self.trials[size]))
        typed = f"{self.command(size)}  # PPO, {self.episodes[PPO][size]} episodes"
        tasks.append(
            Measurement(
                f"{self.stem}_ppo", minutes[PPO], partial(self._ppo, size), typed,
                (SCENES / f"{self.scene}.yaml",), self._ppo_overrides(size), seeds=self.trials[size],
            )
        )  # fmt: skip
        return tasks

    def _ppo_overrides(self, size: Size) -> tuple[str, ...]:
        """Return the overrides of the scene that PPO learns in."""
        return tuple(override for override in (*self.overrides(size), self.squared) if override)

    def _ppo(self, size: Size, folder: Path, deadline: float) -> bool:
        """Train PPO from every seed, each into a CSV of its own; return whether all are there."""
        header = f"measure of {self.tasks(size)[-1].fingerprint()}"
        can_train = importlib.util.find_spec("stable_baselines3") is not None
        for seed in range(self.trials[size]):
            file = folder / f"{self.stem}-{seed}.csv"
            committed = COMMITTED / size / file.name
            if file.exists():
                continue
            if can_train:
                if time.monotonic() > deadline or not self._train(file, header, seed, deadline, size):
                    return False
            elif committed.exists() and committed.read_text().startswith(f"{header}\n"):
                print("    PPO: stable_baselines3 is not installed, so the committed curve is shown")
                write_json(folder / REMARK, NOT_TRAINED)
                write_text(file, committed.read_text())
            else:
                raise TaskError("PPO cannot be trained: stable_baselines3 is not installed: pip install 'cqrun[rl]'")
        return True

    def _train(self, file: Path, header: str, seed: int, deadline: float, size: Size) -> bool:
        """Train PPO from one seed; return whether there was time enough."""
        episodes, scene = self.episodes[PPO][size], SCENES / f"{self.scene}.yaml"
        words = [scene, episodes, seed, file, header, *self._ppo_overrides(size)]
        command = [sys.executable, "-m", "benchmarks.papers.families.train_ppo", *map(str, words)]

        def report() -> None:
            done = episodes_in(checkpoint_of(file))
            print(f"    PPO of seed {seed}: {done} of {episodes} episodes", flush=True)

        ended = run_command(f"PPO of seed {seed}", command, deadline, report)
        if ended.status not in (0, STOPPED):
            raise TaskError(f"PPO of seed {seed} ended with {ended.status}\n{ended.output}")
        return ended.status == 0

    def table(self, folders: Folders, size: Size) -> Table:
        """Return method, seed, episode, measure."""
        rows: list[dict[str, object]] = []
        for name, method, per_iteration in ((self.stem, GRADIENT, 1), (f"{self.stem}_cma_es", CMA, POPULATION)):
            for run in runs_below(folders[name]) if name in folders else ():
                measure = np.sqrt(run.history["loss"]) if self.distance else run.history["loss"]
                rows += _rows(method, run.seed, 1 + per_iteration * np.arange(len(measure)), measure)
        if f"{self.stem}_ppo" in folders:
            for seed in range(self.trials[size]):
                file = folders[f"{self.stem}_ppo"] / f"{self.stem}-{seed}.csv"
                if file.exists():
                    measure = np.loadtxt(file, skiprows=1, ndmin=1)
                    rows += _rows(PPO, seed, 1 + np.arange(len(measure)), measure)
        return table_of(rows)

    def averaged(self, table: Table) -> dict[str, list[tuple[Array, Array]]]:
        """Return (episodes, measure) of every seed by method, averaged as in the paper."""
        curves: dict[str, list[tuple[Array, Array]]] = {}
        for method in dict.fromkeys(table["method"]):
            of_method = table["method"] == method
            for seed in np.unique(table["seed"][of_method]):
                of_seed = of_method & (table["seed"] == seed)
                measure = moving_mean(table["measure"][of_seed], self.windows.get(method, 1))
                curves.setdefault(method, []).append((table["episode"][of_seed], measure))
        return curves

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw every seed, and the paper's points as diamonds."""
        picture = new_figure(6.4, 3.8)
        axes = picture.add_subplot()
        colours = dict(zip((GRADIENT, CMA, PPO), COLOURS, strict=False))
        for method, points in self.printed.items():  # also if ours were not run
            x, y = zip(*points, strict=True)
            axes.plot(x, y, "D", color=colours[method], mec="white", ms=7, zorder=4, label=f"{method}, paper")
        for method, seeds in self.averaged(table).items():
            for k, (episode, measure) in enumerate(seeds):
                axes.plot(episode, measure, color=colours[method], lw=1.2, alpha=0.8, label=None if k else method)
        for threshold in self.thresholds:
            axes.axhline(threshold, color="0.5", lw=0.8, ls=":")
        axes.set_xscale("log")
        if self.distance:
            axes.set_yscale("log")
        axes.set_xlabel("episodes")
        axes.set_ylabel(self.label)
        axes.legend()
        titled(axes, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the gradient's episodes to each threshold beside the other learners' and the paper's."""
        checks = {}
        for threshold in self.thresholds:
            ours = self.median_count(table, GRADIENT, threshold)
            others = {m: self.median_count(table, m, threshold) for m in (CMA, PPO) if m in table["method"]}
            text = ", ".join(f"{method} {_count(n)}" for method, n in {GRADIENT: ours, **others}.items())
            if others:
                checks[f"below {threshold:g}: {text}"] = all(ours < n for n in others.values())
            if size is Size.PAPER and (limit := self.printed_count(threshold)) is not None:
                counts = self.counts(table, GRADIENT, threshold)
                text = f"{np.sum(counts <= limit)} of {len(counts)} seeds, median {_count(ours)}"
                checks[f"below {threshold:g} within {limit:g} episodes (paper): {text}"] = ours <= limit
        if size is Size.PAPER:
            checks |= self._final_checks(table)
        if PPO not in table["method"]:
            checks["PPO was run"] = False
        verdict = Verdict.of(checks)
        exceeds = size is Size.PAPER and verdict.judgement is Judgement.MET and self._exceeds(table)
        return replace(verdict, judgement=Judgement.EXCEEDED) if exceeds else verdict

    def _final_checks(self, table: Table) -> dict[str, bool]:
        """Return the checks of the gradient's final measure: the paper's, and below PPO's where the paper's is."""
        printed, printed_ppo = self.printed_end(GRADIENT), self.printed_end(PPO)
        if printed is None:
            return {}
        last = self.episodes[GRADIENT][Size.PAPER]
        ours, ppo = (self.median_after(table, method, last) for method in (GRADIENT, PPO))
        seeds = np.unique(table["seed"][table["method"] == GRADIENT])
        text = f"after {last} episodes {ours:.2g} (median of {len(seeds)} seeds), paper {printed:g}"
        checks = {text: ours <= 1.1 * printed}
        if printed_ppo is not None and printed < printed_ppo and PPO in table["method"]:
            text = f"nearer than PPO: {ours:.2g} and {ppo:.2g}, paper {printed:g} and {printed_ppo:g}"
            checks[text] = ours < ppo
        return checks

    def _exceeds(self, table: Table) -> bool:
        """Return whether the gradient is better by more than a tenth than each of the paper's numbers, if any."""
        pairs = [(self.median_count(table, GRADIENT, each), self.printed_count(each)) for each in self.thresholds]
        last = self.episodes[GRADIENT][Size.PAPER]
        pairs.append((self.median_after(table, GRADIENT, last), self.printed_end(GRADIENT)))
        printed = [(ours, paper) for ours, paper in pairs if paper is not None]
        return bool(printed) and all(ours < 0.9 * paper for ours, paper in printed)

    def counts(self, table: Table, method: str, threshold: float) -> Array:
        """Return every seed's episodes to a threshold (S,); infinite if it never passes it."""
        counts = []
        for episode, measure in self.averaged(table).get(method, []):
            k = first_below(measure, threshold)
            counts.append(np.inf if k is None else float(episode[k]))
        return np.array(counts)

    def median_count(self, table: Table, method: str, threshold: float) -> float:
        """Return the median over seeds of the episodes to a threshold; infinite if most seeds never pass it."""
        counts = self.counts(table, method, threshold)
        return float(np.median(counts)) if len(counts) else np.nan

    def median_after(self, table: Table, method: str, episodes: int) -> float:
        """Return the median over seeds of the measure after so many episodes; NaN if not all seeds have so many."""
        seeds = self.averaged(table).get(method, [])
        if not seeds or any(each[-1] < episodes for each, _ in seeds):
            return np.nan
        return float(np.median([measure[each <= episodes][-1] for each, measure in seeds]))

    def printed_end(self, method: str) -> float | None:
        """Return the paper's measure of a method after the last episode, or None."""
        return next((y for x, y in self.printed.get(method, ()) if x == self.episodes[GRADIENT][Size.PAPER]), None)

    def printed_count(self, threshold: float) -> float | None:
        """Return the paper's episodes of the gradient to a threshold, or None."""
        return next((x for x, y in self.printed.get(GRADIENT, ()) if y == threshold), None)


def _count(episodes: float) -> str:
    return "never" if np.isinf(episodes) else "not run" if np.isnan(episodes) else f"{episodes:g}"


def _rows(method: str, seed: int, episode: Array, measure: Array) -> list[dict[str, object]]:
    return [
        {"method": method, "seed": seed, "episode": int(k), "measure": float(value)}
        for k, value in zip(episode, measure, strict=True)
    ]

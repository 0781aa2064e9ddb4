"""A family of figures: the gradient against learners without it, at the same task (CQ1 Fig 7 and V-B).

An episode is one rollout. PPO is stable-baselines3's with its defaults, a network of its own (64 x 64), observations
and rewards normalised; its reward is by how much the loss falls, with the distance instead of its square. CMA-ES has
the scene's own controller. PPO needs the extra `rl`; where that is absent, the committed curves are shown.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.families.histories import first_below, runs_below, smooth
from benchmarks.papers.families.train_ppo import checkpoint_of, episodes_in
from benchmarks.papers.figure import Figure, Judgement, Size, Table, Verdict, judged, stacked
from benchmarks.papers.machinery.measurement import REMARK, Measurement
from benchmarks.papers.machinery.process import STOPPED, when_free
from benchmarks.papers.machinery.work import SCENES, Found, Runs, Work, WorkError
from cqrun.figures.style import COLOURS, new_figure, titled
from cqrun.plugin.contract import Array
from cqrun.store.atomic import write_json, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

KEPT = Path(__file__).parents[1] / "ppo"
"""Curves of PPO that are committed: SIZE/SCENE-SEED.csv, headed by the fingerprint of the work that they are of."""

COMMITTED = "committed curves, the time of their training not counted"
"""Said of PPO where it was not trained."""

GRADIENT, CMA, PPO = "gradient", "CMA-ES", "PPO"


class Learners(Figure):
    """The measure against the episode, for three learners.

    Attributes:
        scene: below scenes/.
        label: the measure, a function of the loss.
        distance: whether the measure is the root of the loss.
        small: overrides of the scene at quick size.
        optimizer: of the scene.
        episodes: of each learner, by size.
        seeds: of the gradient, by size.
        trials: of each other learner, by size.
        minutes: of each learner, by size.
        thresholds: that episodes are counted to.
        windows: episodes over which the gradient and PPO are averaged first.
        printed: method -> points (episode, measure) of the paper.
        squared: override that makes the objective a distance for PPO's reward; empty if the loss is the measure.
    """

    scene: ClassVar[str]
    label: ClassVar[str]
    distance: ClassVar[bool] = True
    small: ClassVar[tuple[str, ...]]
    optimizer: ClassVar[str]
    episodes: ClassVar[dict[str, dict[Size, int]]]
    seeds: ClassVar[dict[Size, int]] = {Size.QUICK: 1, Size.PAPER: 10}
    trials: ClassVar[dict[Size, int]] = {Size.QUICK: 1, Size.PAPER: 3}
    minutes: ClassVar[dict[str, dict[Size, float]]]
    thresholds: ClassVar[tuple[float, ...]]
    windows: ClassVar[dict[str, int]]
    printed: ClassVar[dict[str, Sequence[tuple[float, float]]]] = {}
    squared: ClassVar[str] = "objective.tip.reach.squared=false"

    @property
    def stem(self) -> str:
        """The scene's name."""
        return self.scene.rpartition("/")[2]

    def overrides(self, size: Size) -> tuple[str, ...]:
        """Return the scene's overrides at a size."""
        return self.small if size is Size.QUICK else ()

    def work(self, size: Size) -> Sequence[Work]:
        """Return the learners' work."""
        ours = (*self.overrides(size), f"optimizer.{self.optimizer}.max_iterations={self.episodes[GRADIENT][size]}")
        works: list[Work] = [
            Runs(self.stem, self.minutes[GRADIENT][size], "control", self.scene, ours, self.seeds[size])
        ]
        if CMA in self.episodes:
            generations = self.episodes[CMA][size] // self.population
            method = f"optimizer={{cma_es: {{max_iterations: {generations}, population: {self.population}}}}}"
            name, minutes = f"{self.stem}_cma_es", self.minutes[CMA][size]
            works.append(Runs(name, minutes, "control", self.scene, (*self.overrides(size), method), self.trials[size]))
        told = f"python -m benchmarks.papers --size {size} --only {self.id}  # PPO, {self.episodes[PPO][size]} episodes"
        works.append(
            Measurement(
                f"{self.stem}_ppo", self.minutes[PPO][size], lambda f, end: self._ppo(f, end, size), told,
                (SCENES / f"{self.scene}.yaml",), self._ppo_overrides(size), parts=self.trials[size],
            )
        )  # fmt: skip
        return works

    def _ppo_overrides(self, size: Size) -> tuple[str, ...]:
        """Return the overrides of the scene that PPO learns in."""
        return tuple(override for override in (*self.overrides(size), self.squared) if override)

    population: ClassVar[int] = 16
    """Of a generation of CMA-ES."""

    def _ppo(self, folder: Path, deadline: float, size: Size) -> bool:
        """Train PPO from every seed, each into its CSV; say whether all are there."""
        has_extra = importlib.util.find_spec("stable_baselines3") is not None
        head = f"measure of {self.work(size)[-1].fingerprint()}"
        for seed in range(self.trials[size]):
            file = folder / f"{self.stem}-{seed}.csv"
            if file.exists():
                continue
            kept = KEPT / size / file.name
            if not has_extra and kept.exists() and kept.read_text().startswith(f"{head}\n"):
                print("    PPO: stable_baselines3 is absent, and the curve that is committed is taken")
                write_json(folder / REMARK, COMMITTED)
                write_text(file, kept.read_text())
            elif not has_extra:
                raise WorkError("PPO is left out: it needs stable_baselines3, which is absent: pip install 'cqrun[rl]'")
            elif time.monotonic() > deadline or not self._train(file, head, seed, deadline, size):
                return False
        return True

    def _train(self, file: Path, head: str, seed: int, deadline: float, size: Size) -> bool:
        """Train PPO from one seed; say whether there was time enough."""
        words = [SCENES / f"{self.scene}.yaml", self.episodes[PPO][size], seed, file, head, *self._ppo_overrides(size)]
        command = [sys.executable, "-m", "benchmarks.papers.families.train_ppo", *map(str, words)]

        def tell() -> None:
            done = episodes_in(checkpoint_of(file))
            print(f"    PPO of seed {seed}: {done} of {self.episodes[PPO][size]} episodes", flush=True)

        code, said = when_free(f"PPO of seed {seed}", command, deadline, tell)
        if code not in (0, STOPPED):
            raise WorkError(f"PPO of seed {seed} ended with {code}\n{said}")
        return code == 0

    def table(self, found: Found, size: Size) -> Table:
        """Return method, seed, episode, measure."""
        parts: list[dict[str, object]] = []
        for name, method in ((self.stem, GRADIENT), (f"{self.stem}_cma_es", CMA)):
            for run in runs_below(found[name]) if name in found else ():
                loss = np.sqrt(run.history["loss"]) if self.distance else run.history["loss"]
                per = 1 if method == GRADIENT else self.population
                parts += _rows(method, run.seed, 1 + per * np.arange(len(loss)), loss)
        if f"{self.stem}_ppo" in found:
            for seed in range(self.trials[size]):
                file = found[f"{self.stem}_ppo"] / f"{self.stem}-{seed}.csv"
                if file.exists():
                    measure = np.loadtxt(file, skiprows=1, ndmin=1)
                    parts += _rows(PPO, seed, 1 + np.arange(len(measure)), measure)
        return stacked(iter(parts))

    def smoothed(self, table: Table) -> dict[str, list[tuple[Array, Array]]]:
        """Return (episodes, measure) of every seed by method, averaged as the paper does."""
        found: dict[str, list[tuple[Array, Array]]] = {}
        for method in dict.fromkeys(table["method"]):
            own = table["method"] == method
            for seed in np.unique(table["seed"][own]):
                held = own & (table["seed"] == seed)
                measure = smooth(table["measure"][held], self.windows.get(method, 1))
                found.setdefault(method, []).append((table["episode"][held], measure))
        return found

    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Draw every seed; the paper's points as diamonds."""
        picture = new_figure(6.4, 3.8)
        axes = picture.add_subplot()
        colours = dict(zip((GRADIENT, CMA, PPO), COLOURS, strict=False))
        for method, points in self.printed.items():  # whether or not ours were run
            x, y = zip(*points, strict=True)
            axes.plot(x, y, "D", color=colours[method], mec="white", ms=7, zorder=4, label=f"{method}, paper")
        for method, seeds in self.smoothed(table).items():
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

    def counts(self, table: Table, method: str, threshold: float) -> Array:
        """Return every seed's episodes to a threshold (S,); infinite where it never passes it."""
        counts = []
        for episode, measure in self.smoothed(table).get(method, []):
            k = first_below(measure, threshold)
            counts.append(np.inf if k is None else float(episode[k]))
        return np.array(counts)

    def episodes_to(self, table: Table, method: str, threshold: float) -> float:
        """Return the median over seeds of the episodes to a threshold; infinite where most never pass it."""
        counts = self.counts(table, method, threshold)
        return float(np.median(counts)) if len(counts) else np.nan

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the episodes to each threshold: those of the gradient beside the others', and the paper's."""
        checks = {}
        for threshold in self.thresholds:
            ours = self.episodes_to(table, GRADIENT, threshold)
            others = {m: self.episodes_to(table, m, threshold) for m in (CMA, PPO) if m in table["method"]}
            told = ", ".join(f"{method} {_count(n)}" for method, n in {GRADIENT: ours, **others}.items())
            if others:
                checks[f"below {threshold:g}: {told}"] = all(ours < n for n in others.values())
            if size is Size.PAPER and (limit := self.allowed(threshold)) is not None:
                counts = self.counts(table, GRADIENT, threshold)
                told = f"{np.sum(counts <= limit)} of {len(counts)} seeds, in the median {_count(ours)}"
                checks[f"below {threshold:g} within {limit:g} episodes (paper): {told}"] = ours <= limit
        if size is Size.PAPER:
            checks |= self._ends(table)
        if PPO not in table["method"]:
            checks["PPO was run"] = False
        verdict = judged(checks)
        exceeds = size is Size.PAPER and verdict.judgement is Judgement.MET and self._exceeds(table)
        return replace(verdict, judgement=Judgement.EXCEEDED) if exceeds else verdict

    def _ends(self, table: Table) -> dict[str, bool]:
        """Return checks of where the gradient ends: as near as the paper's, and nearer than PPO where that one is."""
        wanted, other = (self.printed_end(method) for method in (GRADIENT, PPO))
        if wanted is None:
            return {}
        last = self.episodes[GRADIENT][Size.PAPER]
        ours, theirs = (self.after(table, method, last) for method in (GRADIENT, PPO))
        seeds = np.unique(table["seed"][table["method"] == GRADIENT])
        told = f"after {last} episodes {ours:.2g} (median of {len(seeds)} seeds), paper {wanted:g}"
        checks = {told: ours <= 1.1 * wanted}
        if other is not None and wanted < other and PPO in table["method"]:
            checks[f"nearer than PPO: {ours:.2g} and {theirs:.2g}, paper {wanted:g} and {other:g}"] = ours < theirs
        return checks

    def _exceeds(self, table: Table) -> bool:
        """Say whether the gradient does better by more than a tenth than each of the paper's numbers, if it has any."""
        pairs = [(self.episodes_to(table, GRADIENT, each), self.allowed(each)) for each in self.thresholds]
        pairs.append((self.after(table, GRADIENT, self.episodes[GRADIENT][Size.PAPER]), self.printed_end(GRADIENT)))
        printed = [(ours, theirs) for ours, theirs in pairs if theirs is not None]
        return bool(printed) and all(ours < 0.9 * theirs for ours, theirs in printed)

    def after(self, table: Table, method: str, episodes: int) -> float:
        """Return the median over seeds of the measure after so many episodes; NaN where one has fewer, or none is."""
        seeds = self.smoothed(table).get(method, [])
        if not seeds or any(each[-1] < episodes for each, _ in seeds):
            return np.nan
        return float(np.median([measure[each <= episodes][-1] for each, measure in seeds]))

    def printed_end(self, method: str) -> float | None:
        """Return where the paper's curve of a method ends, if that is printed: its point at the last episode."""
        return next((y for x, y in self.printed.get(method, ()) if x == self.episodes[GRADIENT][Size.PAPER]), None)

    def allowed(self, threshold: float) -> float | None:
        """Return the paper's episodes of the gradient to a threshold, or None."""
        return next((x for x, y in self.printed.get(GRADIENT, ()) if y == threshold), None)


def _count(episodes: float) -> str:
    return "never" if np.isinf(episodes) else "not run" if np.isnan(episodes) else f"{episodes:g}"


def _rows(method: str, seed: int, episode: Array, measure: Array) -> list[dict[str, object]]:
    return [
        {"method": method, "seed": seed, "episode": int(k), "measure": float(value)}
        for k, value in zip(episode, measure, strict=True)
    ]

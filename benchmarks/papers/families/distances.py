"""A family of figures: distance against iteration and wall time, mean of seeds and its 90 % interval (CQ2 Figs 6-9)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.families.histories import Curves, curves, rows, runs_below, settled
from benchmarks.papers.families.integrity import BEST, WHOLE, checks, worst
from benchmarks.papers.figure import Figure, Judgement, Size, Table, Verdict, judged, lowered, stacked
from benchmarks.papers.machinery.work import Found, Runs, Work
from cqrun.figures.style import COLOURS, GREY, clock_ticks, new_figure, titled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture


SINGLE = ("precision=float32", "memory=8GiB")
"""Overrides at paper size: the papers' own precision, and room for every state of a rollout."""


@dataclass(frozen=True)
class Variant:
    """One set of seeds: its label, overrides of the scene, and how many seeds and minutes at each size."""

    label: str
    overrides: Mapping[Size, tuple[str, ...]]
    seeds: Mapping[Size, int]
    minutes: Mapping[Size, float]


class Distances(Figure):
    """How far a robot comes, against the iteration.

    Attributes:
        scene: below scenes/.
        job: its command.
        term: of the objective that is the distance [m].
        body: that is asked to stay whole.
        variants: the verdict is on the first that the size has, our choice of what the paper leaves open.
        iterations: the paper's.
        start, final: the paper's first and final mean.
        interval: its 90 % interval.
        interval_at: of what it is, where that is not the final mean.
        seconds: its seconds an iteration (GTX 1080).
    """

    scene: ClassVar[str]
    job: ClassVar[str] = "control"
    term: ClassVar[str] = "far"
    body: ClassVar[str]
    variants: ClassVar[Sequence[Variant]]
    iterations: ClassVar[int] = 100
    start: ClassVar[float]
    final: ClassVar[float]
    interval: ClassVar[tuple[float, float]]
    interval_at: ClassVar[str] = ""
    seconds: ClassVar[float]

    tolerance: ClassVar[dict[Size, str]] = {
        Size.QUICK: f"the distance grows: by seed, the end is above the start; {BEST}{WHOLE}",
        Size.PAPER: "at no more iterations, the mean over seeds is the paper's or more; in part within its 90 % "
        f"interval, exceeded above that; {BEST}{WHOLE}",
    }

    def work(self, size: Size) -> Sequence[Work]:
        """Return one command for each variant that the size has."""
        return [
            Runs(self._name(v), v.minutes[size], self.job, self.scene, v.overrides[size], v.seeds[size])
            for v in self.variants
            if size in v.seeds
        ]

    def _name(self, variant: Variant) -> str:
        return f"{Path(self.scene).name}_{variant.label.replace(' ', '_')}"

    def table(self, found: Found, size: Size) -> Table:
        """Return variant, seed, iteration, seconds, value [m]; in a seed's last row, how whole its best run is."""
        parts: list[dict[str, object]] = []
        for variant in self.variants:
            if self._name(variant) in found:
                for run in settled(runs_below(found[self._name(variant)])):
                    own = list(rows(variant.label, [run], {run.seed: run.history[self.term]}))
                    parts += [*own[:-1], own[-1] | worst(run.path, self.body)]
        return stacked(iter(parts))

    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Draw every variant as mean and interval; the paper's start and end, this with its interval, as marks."""
        picture = new_figure(6.4, 3.8)
        axes = picture.add_subplot()
        labels = list(dict.fromkeys(table["variant"]))
        for colour, label in zip(COLOURS, labels, strict=False):
            draw_curves(axes, curves(table, label), label, colour, band=label == labels[0])
        timed = max(labels, key=lambda label: curves(table, label).value.shape[1])
        longest = curves(table, timed)
        end = longest.value.shape[1] - 1
        low, high = self.interval
        printed = np.array([[self.final - low], [high - self.final]])
        label = f"paper, after {self.iterations}: {self.final:g} ({self.interval_at}{low:g} to {high:g})"
        after = [self.iterations]
        axes.errorbar(after, [self.final], yerr=printed, color=GREY, fmt="none", capsize=4, lw=1.2, zorder=4)
        axes.plot([0, *after], [self.start, self.final], "D", color=GREY, mec="white", ms=6, zorder=4, label=label)
        clock = clock_ticks(axes.xaxis, np.arange(end + 1), longest.seconds, self.iterations) if end else "s"
        whose = f" of '{timed}'" if len(labels) > 1 else ""
        axes.set_xlabel(f"iteration, and below it the wall time{whose} [{clock}]")
        axes.set_ylabel("distance travelled [m]")
        axes.legend(loc="best")
        titled(axes, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the first variant that there is."""
        label = next(v.label for v in self.variants if v.label in table["variant"])
        found = curves(table, label)
        own = {name: column[table["variant"] == label] for name, column in table.items()}
        whole = checks(own, len(found.value), BEST)
        first, last = found.value[:, 0], found.value[:, -1]
        if size is Size.QUICK:
            told = f"{first.mean():.2f} -> {last.mean():.2f} m in {found.value.shape[1] - 1} iterations"
            return lowered(judged({told: bool(np.all(last > first))}), whole)
        low, high = self.interval
        mean, half = float(found.mean[-1]), float(found.half[-1])
        seeds = len(found.value)
        ours = f"{mean:.2f} +- {half:.2f} m ({seeds} seeds)" if seeds > 1 else f"{mean:.2f} m (one seed)"
        done = found.value.shape[1] - 1
        early = "" if done >= self.iterations else f" after {done} of {self.iterations} iterations"
        beyond = ", and above it" if mean > high else ""
        verdict = judged({
            f"{ours}{early}, paper {self.final:g}": mean >= self.final,
            f"no less than the paper's 90 % interval, {self.interval_at}{low:g} to {high:g}{beyond}": mean >= low,
        })  # fmt: skip
        return lowered(replace(verdict, judgement=Judgement.EXCEEDED) if mean > high else verdict, whole)


def draw_curves(axes: Axes, found: Curves, label: str, colour: str, *, band: bool = True) -> None:
    """Draw seeds thin, their mean thick, and its interval as a band: of two or three seeds it may hide the rest."""
    x = np.arange(found.value.shape[1])
    if len(found.value) > 1:
        axes.plot(x, found.value.T, color=colour, lw=0.5, alpha=0.35)
    if len(found.value) > 1 and band:
        axes.fill_between(x, found.mean - found.half, found.mean + found.half, color=colour, alpha=0.2, lw=0)
    seeds = f", {len(found.value)} seeds" if len(found.value) > 1 else ""
    axes.plot(x, found.mean, color=colour, lw=1.8, label=f"{label}{seeds}")

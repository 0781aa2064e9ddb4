"""Figures of how far a robot walks, against iteration and wall time: the mean of seeds and its 90 % interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.families.histories import Curves, curve_rows, curves, ended_or_all, runs_below
from benchmarks.papers.families.integrity import IN_BEST, INTACT, checks, worst
from benchmarks.papers.figure import Figure, Folders, Judgement, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.runs import Runs
from cqrun.figures.style import COLOURS, GREY, clock_ticks, new_figure, titled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture


SINGLE = ("precision=float32", "memory=8GiB")
"""Overrides at paper size: the papers' own precision, and memory for every state of a rollout."""


@dataclass(frozen=True)
class Variant:
    """One set of seeds: its label, and at each size the overrides of the scene, the number of seeds, and minutes."""

    label: str
    overrides: Mapping[Size, tuple[str, ...]]
    seeds: Mapping[Size, int]
    minutes: Mapping[Size, float]


class Distances(Figure):
    """How far a robot walks, against the iteration."""

    scene: ClassVar[str]  # below scenes/
    job: ClassVar[str] = "control"
    term: ClassVar[str] = "far"  # of the objective that is the distance [m]
    body: ClassVar[str]  # has to hold together
    variants: ClassVar[Sequence[Variant]]  # the first is judged; the others show choices that the paper leaves open
    iterations: ClassVar[int] = 100  # the paper's, as all below
    start: ClassVar[float]  # mean distance at first [m]
    final: ClassVar[float]  # mean distance in the end [m]
    interval: ClassVar[tuple[float, float]]  # 90 %, of the final mean, or of what `interval_at` says
    interval_at: ClassVar[str] = ""
    seconds: ClassVar[float]  # an iteration, on a GTX 1080

    criteria: ClassVar[dict[Size, str]] = {
        Size.QUICK: f"the final distance of each seed is greater than its first; {IN_BEST}{INTACT}",
        Size.PAPER: "after no more iterations than the paper's, the mean over seeds is at least the paper's; in part "
        f"if it is within the paper's 90 % interval, exceeded if it is above that interval; {IN_BEST}{INTACT}",
    }

    def tasks(self, size: Size) -> Sequence[Runs]:
        """Return one command for each variant that the size has."""
        return [
            Runs(self._name(v), v.minutes[size], self.job, self.scene, v.overrides[size], v.seeds[size])
            for v in self.variants
            if size in v.seeds
        ]

    def _name(self, variant: Variant) -> str:
        return f"{Path(self.scene).name}_{variant.label.replace(' ', '_')}"

    def table(self, folders: Folders, size: Size) -> Table:
        """Return variant, seed, iteration, seconds, value [m]; in a seed's last row, `worst` of its best motion."""
        rows: list[dict[str, object]] = []
        for variant in self.variants:
            if self._name(variant) in folders:
                for run in ended_or_all(runs_below(folders[self._name(variant)])):
                    *earlier, last = curve_rows(variant.label, run, self.term)
                    rows += [*earlier, last | worst(run.path, self.body)]
        return table_of(rows)

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw all variants' means, the first one's interval, and the paper's start, end and interval as marks."""
        picture = new_figure(6.4, 3.8)
        axes = picture.add_subplot()
        labels = list(dict.fromkeys(table["variant"]))
        for colour, label in zip(COLOURS, labels, strict=False):
            draw_curves(axes, curves(table, label), label, colour, band=label == labels[0])
        longest_label = max(labels, key=lambda label: curves(table, label).value.shape[1])
        longest = curves(table, longest_label)
        end = longest.value.shape[1] - 1
        low, high = self.interval
        printed = np.array([[self.final - low], [high - self.final]])
        label = f"paper, after {self.iterations}: {self.final:g} ({self.interval_at}{low:g} to {high:g})"
        after = [self.iterations]
        axes.errorbar(after, [self.final], yerr=printed, color=GREY, fmt="none", capsize=4, lw=1.2, zorder=4)
        axes.plot([0, *after], [self.start, self.final], "D", color=GREY, mec="white", ms=6, zorder=4, label=label)
        clock = clock_ticks(axes.xaxis, np.arange(end + 1), longest.seconds, self.iterations) if end else "s"
        whose = f" of '{longest_label}'" if len(labels) > 1 else ""
        axes.set_xlabel(f"iteration, and below it the wall time{whose} [{clock}]")
        axes.set_ylabel("distance travelled [m]")
        axes.legend(loc="best")
        titled(axes, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the first variant that there is."""
        label = next(v.label for v in self.variants if v.label in table["variant"])
        curve = curves(table, label)
        of_variant = {name: column[table["variant"] == label] for name, column in table.items()}
        intact = checks(of_variant, len(curve.value), IN_BEST)
        first, last = curve.value[:, 0], curve.value[:, -1]
        if size is Size.QUICK:
            text = f"{first.mean():.2f} -> {last.mean():.2f} m in {curve.value.shape[1] - 1} iterations"
            return Verdict.of({text: bool(np.all(last > first))}).also(intact)
        return self._beside_paper(curve).also(intact)

    def _beside_paper(self, curve: Curves) -> Verdict:
        """Return the verdict on the final mean, beside the paper's mean and interval."""
        low, high = self.interval
        mean, half = float(curve.mean[-1]), float(curve.half[-1])
        seeds, iterations = len(curve.value), curve.value.shape[1] - 1
        ours = f"{mean:.2f} +- {half:.2f} m ({seeds} seeds)" if seeds > 1 else f"{mean:.2f} m (one seed)"
        early = "" if iterations >= self.iterations else f" after {iterations} of {self.iterations} iterations"
        beyond = ", and above it" if mean > high else ""
        verdict = Verdict.of({
            f"{ours}{early}, paper {self.final:g}": mean >= self.final,
            f"no less than the paper's 90 % interval, {self.interval_at}{low:g} to {high:g}{beyond}": mean >= low,
        })  # fmt: skip
        return replace(verdict, judgement=Judgement.EXCEEDED) if mean > high else verdict


def draw_curves(axes: Axes, curve: Curves, label: str, colour: str, *, band: bool = True) -> None:
    """Draw each seed as a thin line, their mean as a thick one, and the interval of the mean as a band."""
    x = np.arange(curve.value.shape[1])
    if len(curve.value) > 1:
        axes.plot(x, curve.value.T, color=colour, lw=0.5, alpha=0.35)
    if len(curve.value) > 1 and band:
        axes.fill_between(x, curve.mean - curve.half, curve.mean + curve.half, color=colour, alpha=0.2, lw=0)
    seeds = f", {len(curve.value)} seeds" if len(curve.value) > 1 else ""
    axes.plot(x, curve.mean, color=colour, lw=1.8, label=f"{label}{seeds}")

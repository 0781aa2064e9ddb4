"""Figures of which material parameters help a walker: all eight combinations of three (CQ2 Figs 11 to 14)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import yaml

from benchmarks.papers.families.histories import Run, curve_rows, curves, runs_below
from benchmarks.papers.families.integrity import IN_BEST, INTACT, checks, worst
from benchmarks.papers.figure import Figure, Folders, Judgement, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.runs import Runs
from cqrun.figures.style import COLOURS, INK, clock_ticks, new_figure, titled, whole_ticks
from cqrun.jobs.studies.ablation import effects
from cqrun.jobs.studies.seeds import interval
from cqrun.jobs.studies.variants import ALL, CONTROL, group_of
from cqrun.plugin.contract import Array
from cqrun.store.run import read_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

NAMES = {"youngs_modulus": "E", "poissons_ratio": "nu", "density": "mass"}
"""Of the free parameters."""

ORDER = ("control", "mass", "nu", "nu + mass", "E", "E + mass", "E + nu", "all")
"""The variants in the paper's order."""

FREE = {label: frozenset(label.split(" + ")) for label in ORDER} | {
    CONTROL: frozenset(),
    ALL: frozenset(NAMES.values()),
}
"""What is free in each variant."""

RESOLUTION = 0.02
"""Distances are read off the paper's plots no finer than this [m]. What differs by less has no order."""


class Ablation(Figure):
    """Distance after learning, with eight combinations of free parameters."""

    scene: ClassVar[str]  # below scenes/
    term: ClassVar[str] = "far"  # of the objective that is the distance [m]
    body: ClassVar[str]  # has to hold together
    quick: ClassVar[tuple[str, ...]]  # overrides of the scene
    paper_size: ClassVar[tuple[str, ...]] = ()
    seeds: ClassVar[Mapping[Size, int]]
    minutes: ClassVar[Mapping[Size, float]]
    rate: ClassVar[Mapping[Size, float]]  # of learning, for all variants
    printed: ClassVar[Sequence[float]]  # final distances, in the order of `ORDER` [m]
    gain: ClassVar[float]  # of all over control, as printed
    particles: ClassVar[str] = ""  # ours and the paper's, if ours are fewer

    criteria: ClassVar[dict[Size, str]] = {
        Size.QUICK: "with everything free the robot walks farther than with control alone, in the mean and for most "
        f"seeds; for both variants, {IN_BEST}{INTACT}",
        Size.PAPER: "control alone reaches the paper's distance, or its 90 % interval does; without that, nothing else "
        "counts. The gain of everything free is at least nine tenths of the paper's. What E, nu and mass add, in the "
        "mean over variants without them, has the paper's order wherever the paper's values differ by 0.02 m or more, "
        "which is as fine as its plots can be read. The verdict is in part at best with fewer particles than the "
        "paper's, and exceeded if everything free walks more than a tenth farther. Runs that blew up are not counted. "
        f"For control alone and for everything free, {IN_BEST}{INTACT}",
    }

    @property
    def stem(self) -> str:
        """The scene's name."""
        return self.scene.rpartition("/")[2]

    def tasks(self, size: Size) -> Sequence[Runs]:
        """Return the ablation."""
        overrides = self.quick if size is Size.QUICK else self.paper_size
        options = ("--ablate", "--rate", f"{self.rate[size]:g}")
        minutes, seeds = self.minutes[size], self.seeds[size]
        return [Runs(self.stem, minutes, "codesign", self.scene, overrides, seeds, options, variants=len(ORDER))]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return variant, seed, iteration, seconds, value [m]; in a seed's last row, `worst` of its best motion."""
        rows: list[dict[str, object]] = []
        for label, run in sorted(_ended(folders[self.stem]), key=lambda each: (ORDER.index(each[0]), each[1].seed)):
            *earlier, last = curve_rows(label, run, self.term)
            rows += [*earlier, last | (worst(run.path, self.body) if label in (CONTROL, ALL) else {})]
        return table_of(rows)

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw the curves, and the final distances beside the printed ones, of the seeds that are judged."""
        table = _of_shared_seeds(table)
        picture = new_figure(9.0, 3.8)
        left, right = picture.subplots(1, 2)
        labels = [label for label in ORDER if np.any(table["variant"] == label)]
        for colour, label in zip(COLOURS, labels, strict=False):
            each = curves(table, label)
            left.plot(each.mean, color=colour, lw=1.4, label=label)
            mean, half = float(each.mean[-1]), float(each.half[-1])
            right.errorbar([ORDER.index(label)], [mean], yerr=[half], color=colour, fmt="o", ms=5, capsize=3)
        paper = "paper" if size is Size.PAPER else "paper, at its size"
        right.plot(range(len(ORDER)), self.printed, "D", color=INK, mec="white", ms=6, zorder=4, label=paper)
        right.set_ylim(bottom=min(0.0, right.get_ylim()[0]))
        right.set_ylabel("distance travelled [m]")
        right.legend()
        last = curves(table, labels[-1])
        whole_ticks(left.xaxis)
        clock = clock_ticks(left.xaxis, np.arange(len(last.seconds)), last.seconds)
        left.set_xlabel(f"iteration, and below it the wall time of '{labels[-1]}' [{clock}]")
        left.set_ylabel("distance travelled [m]")
        left.legend(ncols=2, fontsize=7)
        right.set_xticks(range(len(ORDER)), ORDER, rotation=35, ha="right")
        titled(left, self.title)
        seeds = len(self.ends(table, labels[0]))
        titled(right, "in the end, " + ("one seed" if seeds == 1 else f"{seeds} seeds, mean and 90 %"))
        return picture

    def ends(self, table: Table, label: str) -> Array:
        """Return the final distance of every seed of a variant."""
        return np.asarray(curves(table, label).value[:, -1])

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge control alone, the gain, and at paper size the order; with the seeds that all variants have."""
        table = _of_shared_seeds(table)
        if {CONTROL, ALL} - set(table["variant"]):
            return Verdict.of({"control alone and everything free were both learned": False})
        control, everything = self.ends(table, CONTROL), self.ends(table, ALL)
        both = np.isin(table["variant"], (CONTROL, ALL))
        motions = len(control) + len(everything)
        intact = checks({name: column[both] for name, column in table.items()}, motions, IN_BEST)
        if size is Size.QUICK:
            return Verdict.of(_farther(control, everything)).also(intact)
        verdict = Verdict.of(self._beside_paper(table, control, everything))
        if verdict.judgement is Judgement.MET and everything.mean() > 1.1 * self.printed[-1]:
            verdict = replace(verdict, judgement=Judgement.EXCEEDED)
        return verdict.also(intact)

    def _beside_paper(self, table: Table, control: Array, everything: Array) -> dict[str, bool]:
        """Return the checks of control alone, the gain and the order, beside the paper's."""
        reach, printed = interval(control.tolist()), self.printed[0]
        reaches = bool(max(reach.mean or 0.0, reach.high or 0.0) >= printed)
        gain = interval(((everything - control) / abs(control.mean())).tolist())
        spread = f" ({_percent(gain.low)} to {_percent(gain.high)})" if gain.low is not None else ""
        seeds = _seeds(len(everything))
        gains = f"gain of {seeds} {_percent(gain.mean)}{spread}, paper {_percent(self.gain)}"
        fewer = {f"at the paper's size: {self.particles}": False} if self.particles else {}
        return {
            f"control {control.mean():.2f} m, paper {printed:g}": reaches,
            gains: reaches and float(gain.mean or 0.0) >= 0.9 * self.gain,
            **{text: reaches and agrees for text, agrees in self._order(table).items()},
            **fewer,
        }

    def _order(self, table: Table) -> dict[str, bool]:
        """Return the check that what each parameter adds has the paper's order; nothing if the paper has no order."""
        if missing := set(ORDER) - set(table["variant"]):
            return {f"what each adds: not known without {', '.join(sorted(missing))}": False}
        ours = effects({FREE[label]: self.ends(table, label) for label in ORDER})
        paper = effects({FREE[label]: np.array([far]) for label, far in zip(ORDER, self.printed, strict=True)})
        ranking = " > ".join(f"{group} {_spread(ours[group])}" for group in sorted(ours, key=lambda g: -ours[g].mean()))
        printed = ", ".join(f"{group} {paper[group].mean():+.2f}" for group in sorted(paper))
        pairs = [
            (more, less)
            for more, less in permutations(paper, 2)
            if round(float(paper[more].mean() - paper[less].mean()), 4) >= RESOLUTION
        ]
        agrees = all(ours[more].mean() > ours[less].mean() for more, less in pairs)
        return {f"what each adds: {ranking}; paper {printed}": agrees} if pairs else {}


def _ended(folder: Path) -> Iterator[tuple[str, Run]]:
    """Yield the runs below a folder that ended well, with the labels of their variants."""
    for run in runs_below(folder):
        if run.finished and read_record(run.path)["status"] != "failed":
            unknowns = yaml.safe_load((run.path / "scene.yaml").read_text()).get("unknowns") or {}
            free = {NAMES[group_of(path)] for path in unknowns}
            yield next(label for label in ORDER if FREE[label] == free), run


def _of_shared_seeds(table: Table) -> Table:
    """Return a table of the seeds that all its variants have, so that variants can be compared seed by seed."""
    seeds = [set(table["seed"][table["variant"] == variant]) for variant in np.unique(table["variant"])]
    shared = np.isin(table["seed"], list(set.intersection(*seeds)))
    return {name: column[shared] for name, column in table.items()}


def _farther(control: Array, everything: Array) -> dict[str, bool]:
    """Return the checks that everything free walks farther than control alone, in the mean and for most seeds."""
    seeds, better = len(everything), int(np.count_nonzero(everything > control))
    text = f"control alone and everything free, {_seeds(seeds)}: {control.mean():.2f} -> {everything.mean():.2f} m"
    checks = {text: bool(everything.mean() > control.mean())}
    if seeds == 1:
        return checks
    return checks | {f"{better} of {seeds} seeds walk farther with everything free": better > seeds / 2}


def _seeds(count: int) -> str:
    return "one seed" if count == 1 else f"{count} seeds"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:+.0f} %"


def _spread(values: Array) -> str:
    found = interval(values.tolist())
    if found.low is None:
        return f"{found.mean:+.2f} m"
    return f"{found.mean:+.2f} m ({found.low:+.2f} to {found.high:+.2f})"

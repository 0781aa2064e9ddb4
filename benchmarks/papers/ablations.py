"""A family of figures: which material parameters help a walker, all eight combinations of three (CQ2 Figs 11 to 14)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import yaml

from benchmarks.papers.figure import Figure, Judgement, Size, Table, Verdict, judged, lowered, stacked
from benchmarks.papers.histories import Run, curves, rows, runs_below
from benchmarks.papers.wholeness import BEST, WHOLE, checks, worst
from benchmarks.papers.work import Found, Runs, Work
from cqrun.figures.style import COLOURS, INK, clock_ticks, new_figure, titled, whole_ticks
from cqrun.jobs.studies.ablation import effects
from cqrun.jobs.studies.seeds import interval
from cqrun.jobs.studies.variants import ALL, CONTROL, group_of
from cqrun.plugin.contract import Array
from cqrun.store.run import read_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

NAMES = {"youngs_modulus": "E", "poissons_ratio": "nu", "density": "mass"}
"""Of what is free, in the order of a variant's label."""

ORDER = ("control", "mass", "nu", "nu + mass", "E", "E + mass", "E + nu", "all")
"""The paper's."""

READ = 0.02
"""Distances are read off the paper's plots no finer than this [m]: what differs by less has no order."""


class Ablation(Figure):
    """Distance after learning, with eight combinations of what is free.

    Attributes:
        scene: below scenes/.
        term: of the objective that is the distance [m].
        body: that is asked to stay whole.
        quick, paper_size: overrides of the scene.
        seeds, minutes: by size.
        rate: of learning, of all variants.
        printed: final distances, in the order of `ORDER` [m].
        gain: of all over control, as printed.
        particles: ours and the paper's, where ours are fewer.
    """

    scene: ClassVar[str]
    term: ClassVar[str] = "far"
    body: ClassVar[str]
    quick: ClassVar[tuple[str, ...]]
    paper_size: ClassVar[tuple[str, ...]] = ()
    seeds: ClassVar[Mapping[Size, int]]
    minutes: ClassVar[Mapping[Size, float]]
    rate: ClassVar[Mapping[Size, float]]
    printed: ClassVar[Sequence[float]]
    gain: ClassVar[float]
    particles: ClassVar[str] = ""

    tolerance: ClassVar[dict[Size, str]] = {
        Size.QUICK: "the design with everything free goes farther than control alone, in the mean and in most seeds; "
        f"of both, {BEST}{WHOLE}",
        Size.PAPER: "control alone reaches the paper's distance, or its 90 % interval does, without which nothing else "
        "counts; the gain of all is nine tenths of the paper's or more; what E, nu and mass add, in the mean over "
        "variants without, is in the paper's order, where its differ by .02 m at least, as its plots are read. "
        "In part at best with fewer particles than the paper's; exceeded if all goes more than a tenth farther. Runs "
        f"that blew up are left out; of control alone and of all, {BEST}{WHOLE}",
    }

    @property
    def stem(self) -> str:
        """The scene's name."""
        return self.scene.rpartition("/")[2]

    def work(self, size: Size) -> Sequence[Work]:
        """Return the ablation."""
        small = self.quick if size is Size.QUICK else self.paper_size
        options = ("--ablate", "--rate", f"{self.rate[size]:g}")
        minutes, seeds = self.minutes[size], self.seeds[size]
        return [Runs(self.stem, minutes, "codesign", self.scene, small, seeds, options, variants=len(ORDER))]

    def table(self, found: Found, size: Size) -> Table:
        """Return variant, seed, iteration, seconds, value [m]; in a seed's last row, how whole its best run is."""
        parts: list[dict[str, object]] = []
        for label, run in sorted(_ended(found[self.stem]), key=lambda each: (ORDER.index(each[0]), each[1].seed)):
            own = list(rows(label, [run], {run.seed: run.history[self.term]}))
            parts += [*own[:-1], own[-1] | (worst(run.path, self.body) if label in (CONTROL, ALL) else {})]
        return stacked(iter(parts))

    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Draw curves, and the ends beside the printed ones, of the seeds that are judged."""
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
        timed = curves(table, labels[-1])
        whole_ticks(left.xaxis)
        clock = clock_ticks(left.xaxis, np.arange(len(timed.seconds)), timed.seconds)
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
        """Judge control, the gain, and at the paper's size the order; gains of the seeds that all variants have."""
        table = _of_shared_seeds(table)
        if {CONTROL, ALL} - set(table["variant"]):
            return judged({"control alone and everything free were both learned": False})
        control, every = self.ends(table, CONTROL), self.ends(table, ALL)
        gain = interval(((every - control) / abs(control.mean())).tolist())
        judged_ones = np.isin(table["variant"], (CONTROL, ALL))
        whole = checks({name: column[judged_ones] for name, column in table.items()}, len(control) + len(every), BEST)
        if size is Size.QUICK:
            return lowered(judged(_farther(control, every)), whole)
        between = f" ({gain.low:+.0%} to {gain.high:+.0%})" if gain.low is not None else ""
        told = f"gain of {_seeds(len(every))} {gain.mean:+.0%}{between}, paper {self.gain:+.0%}"
        wanted, farthest = self.printed[0], self.printed[-1]
        reach = interval(control.tolist())
        reaches = bool(max(reach.mean or 0.0, reach.high or 0.0) >= wanted)
        fewer = {f"at the paper's size: {self.particles}": False} if self.particles else {}
        verdict = judged({
            f"control {control.mean():.2f} m, paper {wanted:g}": reaches,
            told: reaches and float(gain.mean or 0.0) >= 0.9 * self.gain,
            **{told: reaches and agrees for told, agrees in self._order(table).items()},
            **fewer,
        })  # fmt: skip
        exceeds = verdict.judgement is Judgement.MET and every.mean() > 1.1 * farthest
        return lowered(replace(verdict, judgement=Judgement.EXCEEDED) if exceeds else verdict, whole)

    def _order(self, table: Table) -> dict[str, bool]:
        """Return what each kind adds, in words, and whether that is in the paper's order; nothing if that has none."""
        if lacking := set(ORDER) - set(table["variant"]):
            return {f"what each adds: not known without {', '.join(sorted(lacking))}": False}
        ours = effects({_free(label): self.ends(table, label) for label in ORDER})
        theirs = effects({_free(label): np.array([far]) for label, far in zip(ORDER, self.printed, strict=True)})
        each = " > ".join(f"{group} {_spread(ours[group])}" for group in sorted(ours, key=lambda g: -ours[g].mean()))
        printed = ", ".join(f"{group} {theirs[group].mean():+.2f}" for group in sorted(theirs))
        pairs = [
            (more, less)
            for more, less in permutations(theirs, 2)
            if round(float(theirs[more].mean() - theirs[less].mean()), 4) >= READ
        ]
        agrees = all(ours[more].mean() > ours[less].mean() for more, less in pairs)
        return {f"what each adds: {each}; paper {printed}": agrees} if pairs else {}


def _ended(folder: Path) -> Iterator[tuple[str, Run]]:
    """Yield the runs below a folder that ended well, with what their variants are called; at first, few."""
    for run in runs_below(folder):
        if run.finished and read_record(run.path)["status"] != "failed":
            free = yaml.safe_load((run.path / "scene.yaml").read_text()).get("unknowns") or {}
            yield _label({group_of(path) for path in free}), run


def _of_shared_seeds(table: Table) -> Table:
    """Return a table without the seeds that one of its variants lacks, so that they can be compared in pairs."""
    seeds = [set(table["seed"][table["variant"] == variant]) for variant in np.unique(table["variant"])]
    own = np.isin(table["seed"], list(set.intersection(*seeds)))
    return {name: column[own] for name, column in table.items()}


def _farther(control: Array, every: Array) -> dict[str, bool]:
    """Return the checks that everything free goes farther than control alone: the mean, and most seeds."""
    seeds, better = len(every), int(np.count_nonzero(every > control))
    told = f"all beside control, {_seeds(seeds)}"
    checks = {f"{told}: {control.mean():.2f} -> {every.mean():.2f} m": bool(every.mean() > control.mean())}
    return checks if seeds == 1 else checks | {f"{better} of {seeds} seeds go farther with all": better > seeds / 2}


def _seeds(count: int) -> str:
    return "one seed" if count == 1 else f"{count} seeds"


def _spread(values: Array) -> str:
    found = interval(values.tolist())
    if found.low is None:
        return f"{found.mean:+.2f} m"
    return f"{found.mean:+.2f} m ({found.low:+.2f} to {found.high:+.2f})"


def _free(label: str) -> frozenset[str]:
    if label in (CONTROL, ALL):
        return frozenset(NAMES.values() if label == ALL else ())
    return frozenset(label.split(" + "))


def _label(free: Set[str]) -> str:
    if len(free) in (0, len(NAMES)):
        return ALL if free else CONTROL
    return " + ".join(short for group, short in NAMES.items() if group in free)

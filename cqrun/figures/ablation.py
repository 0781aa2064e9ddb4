"""ablation.png: a term of the objective against the iteration for every variant of a design, and the final values."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

from cqrun.figures.compare import Group, plot_group
from cqrun.figures.losses import term_curve, term_names
from cqrun.figures.quantities import capitalised
from cqrun.figures.run_data import read_run
from cqrun.figures.style import COLOURS, new_figure, save, styled, titled, whole_ticks
from cqrun.store.model_file import path_of
from cqrun.store.study import Ablation, read_ablation

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_ablation(path: Path, kinds: tuple[str, ...] = ("png",)) -> list[Path]:
    """Draw the comparison that `ablate` wrote to `path`, in the same folder; return the paths of the pictures."""
    with styled():
        return save(_figure(read_ablation(path)), path.with_suffix(""), kinds)


def _figure(result: Ablation) -> Figure:
    compared, variants = result.compared, result.variants
    figure = new_figure(9.0, 1.6 + 0.3 * len(variants) + 1.2)
    by_iteration, ends = figure.subplots(1, 2)
    for place, (name, entry) in enumerate(variants.items()):
        colour, value = COLOURS[place % len(COLOURS)], entry.terms[compared]
        # some runs fail at the start, and some optimizers report no terms
        runs = [run for run in map(read_run, map(path_of, entry.runs)) if compared in term_names(run)]
        if runs:
            plot_group(by_iteration, Group(name, tuple(term_curve(run, compared) for run in runs)), colour, None)
        if value.mean is None:  # all runs of this variant have failed
            continue
        low, high = (value.mean if end is None else end for end in (value.low, value.high))
        ends.plot([low, high], [place, place], color=colour, linewidth=4, alpha=0.35, solid_capstyle="butt")
        ends.plot(value.mean, place, marker="o", color=colour)
        if place and entry.gain is not None:
            ends.annotate(f"{entry.gain.mean:+.0%}", (high, place), (5, 0), textcoords="offset points", va="center")
    ends.set_yticks(range(len(variants)), list(variants))
    for tick, colour in zip(ends.get_yticklabels(), itertools.cycle(COLOURS)):
        tick.set_color(colour)  # so that the names also belong to the curves
    ends.invert_yaxis()
    ends.margins(x=0.15)
    ends.locator_params(axis="x", nbins=4)  # nearly equal values have long labels
    whole_ticks(by_iteration.xaxis)
    by_iteration.set_xlabel("iteration")
    titled(by_iteration, capitalised(compared))
    interval = f"{100 * result.confidence:.0f} % interval"
    titled(ends, f"{capitalised(compared)} learned: mean, {interval}, gain over control")
    return figure

"""material.png: tests and all laws, their errors, where each law is stable, and relaxation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.figures.style import COLOURS, GREY, INK, PALE, log_ticks, new_figure, titled
from cqrun.materials.curves import MODES, Mode
from cqrun.tensile.choice import Judged
from cqrun.tensile.material import Material
from cqrun.tensile.reading import modes_in
from cqrun.tensile.relaxation import Relaxation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FINE = 300
BEYOND = 1.15
"""Curves of laws are drawn up to this part of the largest tested stretch."""

MPA, PERCENT = 1e-6, 100.0
MARKED = 80
"""Tests with more points are drawn as dots without edges."""


def draw_material(material: Material | None, relaxations: Sequence[Relaxation] = ()) -> Figure:
    """Draw a column for each tested mode (stress, errors), one for the stable ranges, and one for each relaxation."""
    modes = modes_in(material.curves) if material is not None else []
    columns = len(modes) + (material is not None) + len(relaxations)
    figure = new_figure(max(3.9 * columns, 5.0), 5.4)
    grid = figure.add_gridspec(2, columns, height_ratios=(1.6, 1.0))
    if material is not None:
        for k, mode in enumerate(modes):
            top = figure.add_subplot(grid[0, k])
            _stress(top, material, mode, labelled=k == 0)
            _errors(figure.add_subplot(grid[1, k], sharex=top), material, mode)
        side = figure.add_subplot(grid[0, len(modes)])
        _stable(side, material)
        _legend(figure.add_subplot(grid[1, len(modes)]), material)
    for k, relaxation in enumerate(relaxations, start=columns - len(relaxations)):
        _relaxation(figure.add_subplot(grid[0, k]), figure.add_subplot(grid[1, k]), relaxation)
    return figure


def _colours(material: Material) -> dict[str, str]:
    return {item.law.name: COLOURS[k % len(COLOURS)] for k, item in enumerate(material.laws)}


def _style(material: Material, item: Judged) -> dict[str, Any]:
    of: dict[str, Any] = {"color": _colours(material)[item.law.name]}
    return of | ({"linewidth": 2.4, "zorder": 3} if item is material.chosen else {"linewidth": 1.1, "zorder": 2})


def _stress(axes: Axes, material: Material, mode: Mode, labelled: bool) -> None:
    own = [curve for curve in material.curves if curve.mode == mode]
    low, high = min(1.0, *(c.stretch.min() for c in own)), max(1.0, *(c.stretch.max() for c in own))
    largest = max(curve.largest_stress for curve in own) * MPA
    stretch = np.linspace(1.0 - BEYOND * (1.0 - low), 1.0 + BEYOND * (high - 1.0), FINE)
    for curve in own:
        style: dict[str, Any] = {"ms": 4.0, "mfc": "none"} if len(curve.stretch) <= MARKED else {"ms": 2.2, "mfc": GREY}
        axes.plot(curve.stretch, curve.stress * MPA, "o", color=GREY, mew=0.8, zorder=1, **style)
    for item in material.laws:
        stress = item.law.stress(item.fit.values, mode, stretch) * MPA
        first, last = item.stable[mode]
        inside = (stretch >= first) & (stretch <= last)
        axes.plot(stretch, np.where(inside, stress, np.nan), **_style(material, item))
        axes.plot(stretch, np.where(inside, np.nan, stress), linestyle=":", **_style(material, item))
    axes.axvspan(high, stretch[-1], color=PALE, alpha=0.5, lw=0, zorder=0)
    axes.set_xlim(stretch[0], stretch[-1])
    floor = 1.2 * min(0.0, *(float(c.stress.min()) * MPA for c in own)) - 0.03 * largest
    axes.set_ylim(floor, 1.25 * max(float(c.stress.max()) * MPA for c in own) + 0.03 * largest)
    axes.set_ylabel("nominal stress (MPa)" if labelled else "")
    titled(axes, mode, "dotted: law unstable; grey: beyond the test" if labelled else "")


def _errors(axes: Axes, material: Material, mode: Mode) -> None:
    for item in material.laws:
        style = _style(material, item)
        for part, curve in zip(item.fit.parts, item.fit.curves, strict=True):
            if curve.mode == mode:
                order = np.argsort(curve.stretch)
                axes.plot(curve.stretch[order], PERCENT * item.fit.residuals[part][order], **style)
    good = PERCENT * max(3.0 * material.chosen.fit.rms, 0.02)
    axes.set_ylim(-max(good, 4.0), max(good, 4.0))
    axes.axhline(0.0, color=INK, lw=0.6)
    axes.set_xlabel("stretch")
    axes.set_ylabel("error (% of largest stress)")


def _stable(axes: Axes, material: Material) -> None:
    """Draw a bar for each law and mode, from the smallest to the largest stretch where it is stable."""
    names = [item.law.title for item in material.laws]
    for row, item in enumerate(material.laws):
        for k, mode in enumerate(MODES):
            low, high = item.stable[mode]
            place = row + 0.25 * (k - 1)
            axes.barh(place, high - low, 0.2, left=low, alpha=1.0 - 0.3 * k, color=_colours(material)[item.law.name])
            axes.plot(np.array(item.needed[mode]), [place, place], color=INK, lw=1.0)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    ends = [end for item in material.laws for stable in item.stable.values() for end in stable]
    low, high = max(0.25, min(ends)), max(ends)
    axes.set_xlim(low, high)
    log_ticks(axes.xaxis, low, high)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("stretch")
    titled(axes, "stable range", "uniaxial, planar, equibiaxial; lines: tested")


def _legend(axes: Axes, material: Material) -> None:
    axes.set_axis_off()
    for item in sorted(material.laws, key=lambda item: item.fit.rms):
        mark = " (chosen)" if item is material.chosen else ""
        axes.plot([], [], label=f"{item.law.title}: {item.fit.rms:.2%}{mark}", **_style(material, item))
    axes.legend(loc="upper left", title="error, root mean square", alignment="left")


def _relaxation(top: Axes, below: Axes, relaxation: Relaxation) -> None:
    time, curve = relaxation.curve.time, relaxation.curve
    assert time is not None
    top.plot(time, curve.stress * MPA, "o", color=GREY, ms=2.5, mfc="none")
    top.plot(time, relaxation.stress * MPA, color=COLOURS[0])
    for t in relaxation.prony.times:
        top.axvline(t, color=PALE, lw=1.0)
    below.plot(time, PERCENT * (relaxation.stress - curve.stress) / curve.largest_stress, color=COLOURS[0], lw=1.0)
    for axes in (top, below):
        axes.set_xscale("log")
    below.set_xlabel("time (s)")
    top.set_ylabel("nominal stress (MPa)")
    below.set_ylabel("error (% of largest stress)")
    titled(top, "relaxation", "vertical lines: relaxation times")

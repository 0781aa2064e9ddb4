"""convergence.png: the loss, its terms and every unknown against the iteration (CQ2 Fig 5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.figures.losses import LossCurve, loss_curve, term_curve, term_names
from cqrun.figures.quantities import error, estimate, labels, number, shown_unit
from cqrun.figures.run_data import RunData
from cqrun.figures.style import (
    COLOURS,
    GREY,
    PALE,
    TRUTH,
    clock_ticks,
    legend_label,
    log_ticks,
    new_figure,
    titled,
    whole_ticks,
)
from cqrun.optimizers.constrained import VIOLATION
from cqrun.plugin.contract import Array
from cqrun.scene.paths import canonical, leaf
from cqrun.scene.unknowns import groups_of
from cqrun.store.result import Designed, Identified, Interval, LearnedResult, SysidResult
from cqrun.units import Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE_LOG = 5.0
"""An unknown on a log scale gets a logarithmic axis if the range shown spans at least this factor."""

NEAR = 1.0
"""Bounds at most this far from the values, in units of their span, are drawn; others are only in the title."""


@dataclass(frozen=True)
class UnknownCurve:
    """One unknown over a run, in the unit in which it is shown.

    Attributes:
        path: key path of the unknown.
        label: short name.
        unit: unit in which the numbers are shown.
        log: whether the optimizer sees its logarithm.
        bounds: lower and upper bound.
        values: values (K, n); n = 0 if the history has only the gradient.
        names: names of the n numbers; empty if n < 2.
        gradient: norm of the gradient in scaled coordinates (K,).
        final: the value found (n,), or None if there is none yet.
        intervals: 95 % interval of each number, or None.
        truth: true value of synthetic data, or None.
    """

    path: str
    label: str
    unit: Unit
    log: bool
    bounds: tuple[float, float]
    values: Array
    names: tuple[str, ...]
    gradient: Array
    final: Array | None
    intervals: tuple[tuple[float, float] | None, ...]
    truth: float | None


# --- data ---------------------------------------------------------------------------------------------------


def unknown_curves(run: RunData) -> list[UnknownCurve]:
    """Return the unknowns of a run, in the order of its scene."""
    scene = run.scene
    paths = [canonical(scene, path) for path in scene.unknowns]
    synthetic = scene.synthetic
    truths = {canonical(scene, p): v for p, v in synthetic.truth.items()} if synthetic is not None else {}
    results = run.result.unknowns if isinstance(run.result, SysidResult | LearnedResult) else {}
    curves = []
    for path, label, unknown in zip(paths, labels(paths, scene.dim), scene.unknowns.values(), strict=True):
        lower, upper = unknown.bounds
        unit = shown_unit(leaf(scene, path).unit, max(abs(lower), abs(upper)))
        values = _values(run, path)
        final, intervals = _result(results.get(path), unit)
        truth = unit.factor * truths[path] if path in truths else None
        curves.append(
            UnknownCurve(
                path, label, unit, unknown.scale == "log", (unit.factor * lower, unit.factor * upper),
                unit.factor * values, _names(run, path, unknown.per, values.shape[1], final),
                run.history[f"grad:{path}"], final, intervals, truth,
            )
        )  # fmt: skip
    return curves


def _values(run: RunData, path: str) -> Array:
    columns = [name for name in run.history if name == f"value:{path}" or name.startswith(f"value:{path}[")]
    return np.array([run.history[name] for name in columns]).reshape(len(columns), len(run.history["iteration"])).T


def _names(run: RunData, path: str, per: str, count: int, final: Array | None) -> tuple[str, ...]:
    """Return the names of the numbers: groups, several groups that share a mirrored value, or else indices."""
    if count < 2:
        return ()
    groups = groups_of(run.scene, path) if per == "group" else ()
    if len(groups) == count:
        return groups
    by_value: dict[float, list[str]] = {}
    for name, value in zip(groups, () if final is None else final, strict=False):
        by_value.setdefault(float(value), []).append(name)
    if len(by_value) == count:
        return tuple(", ".join(names) for names in by_value.values())
    return tuple(str(i) for i in range(count))


def _result(unknown: Identified | Designed | None, unit: Unit) -> tuple[Array | None, tuple[Interval | None, ...]]:
    """Return the resulting numbers in their unit, with an interval or None for each."""
    if unknown is None:
        return None, ()
    final = unit.factor * np.atleast_1d(np.array(unknown.value, dtype=float))
    if isinstance(unknown, Designed):
        return final, (None,) * final.size
    _, intervals, _ = unknown.numbers()
    return final, tuple(pair and (unit.factor * pair[0], unit.factor * pair[1]) for pair in intervals)


# --- drawing ------------------------------------------------------------------------------------------------


def draw_convergence(run: RunData) -> Figure:
    """Return the picture: panels for the loss, each of its terms, each unknown, and the gradients."""
    loss = loss_curve(run)
    panels: list[Callable[[Axes], None]] = [
        *([partial(plot_violation, run=run)] if VIOLATION in run.history else []),
        *(partial(plot_loss, loss=term_curve(run, name)) for name in term_names(run)),
        *(partial(plot_unknown, iteration=loss.iteration, curve=curve) for curve in unknown_curves(run)),
    ]
    blocks = gradient_blocks(run)
    if blocks:
        panels.append(partial(_plot_gradients, iteration=loss.iteration, blocks=blocks))
    rows, columns, first = layout(1 + len(panels))
    figure = new_figure(1.0 + 3.0 * columns, 0.5 + 2.35 * rows)
    grid = figure.add_gridspec(rows, columns)
    figure.suptitle(f"{run.name}: {run.status}", fontsize=9, color=GREY, x=0.995, ha="right")
    plot_loss(figure.add_subplot(grid[0, :first]), loss)
    for place, draw in enumerate(panels, first):
        axes = figure.add_subplot(grid[place // columns, place % columns])
        draw(axes)
        if place >= (rows - 1) * columns and not axes.get_xlabel():
            axes.set_xlabel("iteration")
    return figure


def gradient_blocks(run: RunData) -> dict[str, Array]:
    """Return the norm of the gradient (K,) of each block that is not an unknown of the scene, by name."""
    unknowns = {canonical(run.scene, path) for path in run.scene.unknowns}
    norms = {name.removeprefix("grad:"): column for name, column in run.history.items() if name.startswith("grad:")}
    return {name: column for name, column in norms.items() if name not in unknowns}


def layout(panels: int) -> tuple[int, int, int]:
    """Return the numbers of rows and columns, and the columns of the first panel, so that no place remains empty."""
    columns = min(panels, 2 if panels in (2, 4) else 3)
    rows = -(-panels // columns)
    return rows, columns, 1 + rows * columns - panels


def plot_loss(axes: Axes, loss: LossCurve) -> None:
    """Draw the loss or a term, with the wall time below the iterations."""
    axes.plot(loss.iteration, loss.value, color=COLOURS[0], **_marked(len(loss.iteration)))
    if loss.log:
        shown = [*loss.value[loss.value > 0], *([] if loss.floor is None else [loss.floor])]
        if shown:
            _log_axis(axes, min(shown), max(shown))
    if loss.floor is not None:
        text = f"noise: {error(loss.floor)} {loss.unit}\n({error(loss.noise)} {loss.unit} in each coordinate)"
        axes.axhline(loss.floor, color=TRUTH, linestyle="--", linewidth=1.0, label=text)
        axes.legend(loc="upper right")
    if axes.get_yscale() == "linear":  # no power of ten above the axis, because the title is there
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:.5g}".replace("-", "\u2212"))
    whole_ticks(axes.xaxis)
    _pad_iterations(axes, loss.iteration)
    unit = clock_ticks(axes.xaxis, loss.iteration, loss.seconds)
    axes.set_xlabel(f"iteration, wall time ({unit})")
    last = f"{_value(loss, -1)} after {int(loss.iteration[-1])}"
    if loss.best_row is None:
        titled(axes, loss.title, f"{last} iterations")
    else:
        axes.plot(loss.iteration[loss.best_row], loss.value[loss.best_row], "o", ms=6, mfc="none", color=COLOURS[0])
        best = f"best: {_value(loss, loss.best_row)} after {int(loss.iteration[loss.best_row])}"
        titled(axes, loss.title, f"{best}; last: {last}")


def _value(loss: LossCurve, row: int) -> str:
    value = float(loss.value[row])
    return error(value) if loss.unit == "mm" else number(value)


def plot_violation(axes: Axes, run: RunData) -> None:
    """Draw the largest violation of a constraint, in units of its scale, and the tolerance (CQ1 Fig 8, CQ2 Fig 10)."""
    iteration, value = run.history["iteration"], run.history[VIOLATION]
    optimizer: Any = run.scene.optimizer
    met = float(optimizer.value.constraint_tolerance) if optimizer is not None else 0.0
    floor = 0.1 * min(met, *value[value > 0], np.inf)  # zero violations are drawn there
    shown = np.maximum(value, floor)
    none = f"none, drawn at {floor:.0e}" if not value.all() else None
    axes.plot(iteration, shown, color=COLOURS[0], label=none, **_marked(len(iteration)))
    axes.axhline(met, color=TRUTH, linestyle="--", linewidth=1.0, label=f"met: {met:g}")
    _log_axis(axes, min(met, *shown), max(met, *shown))
    axes.legend(loc="best")
    whole_ticks(axes.xaxis)
    _pad_iterations(axes, iteration)
    first = np.flatnonzero(value <= met)
    titled(axes, "Largest violation", f"met after {int(iteration[first[0]])} iterations" if len(first) else "not met")


def _log_axis(axes: Axes, low: float, high: float) -> None:
    """Make the vertical axis logarithmic, from a little below `low` to a little above `high`."""
    ends = _padded_log(low, high)
    axes.set_yscale("log")
    axes.set_ylim(*ends)
    log_ticks(axes.yaxis, *ends)


def _plot_gradients(axes: Axes, iteration: Array, blocks: dict[str, Array]) -> None:
    """Draw the norm of the gradient of every block of parameters."""
    known = [norm[norm > 0] for norm in blocks.values()]
    for k, (name, norm) in enumerate(blocks.items()):
        positive = norm > 0
        colour = COLOURS[k % len(COLOURS)]
        axes.plot(
            iteration[positive], norm[positive], color=colour, label=legend_label(name), **_marked(len(iteration))
        )
    whole_ticks(axes.xaxis)
    _pad_iterations(axes, iteration)
    titled(axes, "Norm of the gradient")
    if not any(norm.size for norm in known):  # the method has no gradients, or they are always zero
        axes.text(0.5, 0.5, "none, or zero", transform=axes.transAxes, ha="center", color=GREY)
        return
    norms = np.concatenate(known)
    _log_axis(axes, float(norms.min()), float(norms.max()))
    if len(blocks) > 3:  # space above the lines for the names in two columns
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** (0.14 * (len(blocks) + 1) / 2))
        axes.legend(loc="upper center", ncols=2, handlelength=1.2, fontsize=6.5)
    else:
        axes.legend(loc="best", handlelength=1.6)


def plot_unknown(axes: Axes, iteration: Array, curve: UnknownCurve, *, show_bounds: bool = True) -> None:
    """Draw one unknown: its values over the iterations, final value with interval, truth and bounds."""
    whole_ticks(axes.xaxis)
    _pad_iterations(axes, iteration)
    name = curve.unit.label(curve.label)
    if curve.values.shape[1] == 0:
        _plot_gradient(axes, iteration, curve, curve.label)
        return
    low, high = view(curve)
    if curve.log and high / low >= WIDE_LOG:
        axes.set_yscale("log")
        log_ticks(axes.yaxis, low, high)
    axes.set_ylim(low, high)
    for bound, beyond in zip(curve.bounds, (low, high), strict=True):
        if low < bound < high:
            axes.axhspan(min(bound, beyond), max(bound, beyond), color=PALE, alpha=0.6, linewidth=0)
    single = curve.values.shape[1] == 1
    if curve.truth is not None:
        axes.axhline(curve.truth, color=TRUTH, linestyle="--", linewidth=1.0, label="truth")
    for k, column in enumerate(curve.values.T):
        label = None if single else legend_label(curve.names[k])
        axes.plot(iteration, column, color=COLOURS[k % len(COLOURS)], label=label, **_marked(len(iteration)))
    _plot_intervals(axes, iteration, curve, (low, high))
    if len(axes.get_legend_handles_labels()[0]):
        axes.legend(loc="best", ncols=1 if len(curve.names) <= 6 else 2, handlelength=1.6)
    titled(axes, name, _summary(curve, show_bounds))


def _plot_gradient(axes: Axes, iteration: Array, curve: UnknownCurve, name: str) -> None:
    """Draw the norm of the gradient of a block that is too large to draw each number."""
    shown = curve.gradient > 0
    axes.plot(iteration[shown], curve.gradient[shown], color=COLOURS[0], **_marked(len(iteration)))
    if shown.any():
        _log_axis(axes, float(curve.gradient[shown].min()), float(curve.gradient[shown].max()))
    axes.set_ylabel("norm of the gradient")
    note = ""
    if curve.final is not None:
        note = f"{curve.final.size} values, {number(curve.final.min())} to {number(curve.final.max())}"
    titled(axes, f"Gradient by {name}", note)


def _plot_intervals(axes: Axes, iteration: Array, curve: UnknownCurve, shown: tuple[float, float]) -> None:
    """Draw the 95 % interval: a band for one number, bars after the last iteration for several."""
    if curve.final is None or not any(curve.intervals):
        return
    low, high = shown
    if len(curve.intervals) == 1 and curve.intervals[0] is not None:
        axes.axhspan(
            *np.clip(curve.intervals[0], max(low, curve.bounds[0]), min(high, curve.bounds[1])),
            color=COLOURS[0], alpha=0.16, linewidth=0, label="95 % interval",
        )  # fmt: skip
        return
    right = axes.get_xlim()[1]
    last = float(iteration[-1])
    axes.plot([], [], color=GREY, linewidth=2.5, alpha=0.6, label="95 % interval")
    for k, pair in enumerate(curve.intervals):
        if pair is not None:
            place = last + (right - last) * (k + 1) / (len(curve.intervals) + 1)
            colour = COLOURS[k % len(COLOURS)]
            axes.plot([place, place], np.clip(pair, low, high), color=colour, linewidth=2.5, alpha=0.6)
            for end, beyond, marker in ((low, pair[0] < low, "v"), (high, pair[1] > high, "^")):
                if beyond:  # the bar continues outside the axes
                    axes.plot(place, end, marker=marker, markersize=4, color=colour, clip_on=False)


def view(curve: UnknownCurve) -> tuple[float, float]:
    """Return the range of an unknown's axis: all its values, and bounds that are near them."""
    lower, upper = curve.bounds
    shown = [*curve.values.ravel(), *(curve.final if curve.final is not None else [])]
    shown += [curve.truth] if curve.truth is not None else []
    for pair in curve.intervals:
        shown += [float(np.clip(end, lower, upper)) for end in pair] if pair is not None else []
    scale = np.log if curve.log else np.asarray
    low, high = float(scale(min(shown))), float(scale(max(shown)))
    bottom, top = float(scale(lower)), float(scale(upper))
    span = high - low or 0.1 * (top - bottom)
    low = bottom if low - bottom <= NEAR * span else low
    high = top if top - high <= NEAR * span else high
    margin = 0.08 * (high - low or span)
    ends = low - margin, high + margin
    return (float(np.exp(ends[0])), float(np.exp(ends[1]))) if curve.log else ends


def _summary(curve: UnknownCurve, show_bounds: bool) -> str:
    """Return the text below an unknown's title: its value with interval, and its bounds."""
    parts = []
    if curve.values.shape[1] == 1 and curve.final is None:
        parts.append(f"{number(float(curve.values[-1, 0]))} so far")
    elif curve.values.shape[1] == 1 and curve.final is not None:
        parts.append(estimate(float(curve.final[0]), curve.intervals[0]))
    if show_bounds:
        parts.append(f"bounds {number(curve.bounds[0])} to {number(curve.bounds[1])}")
    return ", ".join(parts)


def _marked(count: int) -> dict[str, Any]:
    """Return the style of a line with `count` points: few points are marked."""
    return {"marker": "o", "markersize": 3.2} if count <= 40 else {"linewidth": 1.2}


def _pad_iterations(axes: Axes, iteration: Array) -> None:
    first, last = float(iteration[0]), float(iteration[-1])
    margin = 0.04 * (last - first) or 0.5
    axes.set_xlim(first - margin, last + margin)


def _padded_log(low: float, high: float) -> tuple[float, float]:
    factor = (high / low) ** 0.1 if high > low else 1.3
    return low / factor, high * factor

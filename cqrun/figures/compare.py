"""compare.png: the loss of several runs against iteration and wall time, with a band over equal ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.contract import Array
from cqrun.errors import UsageError
from cqrun.figures.convergence import LossCurve, loss_curve
from cqrun.figures.quantities import capitalised
from cqrun.figures.run_data import RunData
from cqrun.figures.style import COLOURS, log_ticks, new_figure, titled, whole_ticks
from cqrun.scene.load import resolve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND_FROM = 3
"""Runs that differ in their seeds alone are drawn as mean and band if there are at least so many."""

CONFIDENCE = 0.90
"""Of the band around the mean."""

SMALLEST = 1e-9
"""Losses are not drawn below this [mm]: a logarithmic axis has no zero."""

TIMES = 200
"""Points in time at which means are taken."""

MOST_DIFFERENCES = 2
"""Runs of one scene that differ in more values than this are told apart by their hash."""


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seeds alone.

    Attributes:
        label: what tells them from the others.
        curves: the loss of each.
    """

    label: str
    curves: tuple[LossCurve, ...]


@dataclass(frozen=True)
class Band:
    """Geometric mean over runs with its confidence interval; x (K,) is iteration or time, the rest (K,) [mm]."""

    x: Array
    mean: Array
    low: Array
    high: Array


# --- data ---------------------------------------------------------------------------------------------------


def groups(runs: Sequence[RunData]) -> list[Group]:
    """Return runs grouped by their scenes without seeds, in order of first appearance.

    Raises:
        UsageError: a run has no history yet, or the runs' losses are not of one kind.
    """
    curves = [loss_curve(run) for run in runs]
    kinds = {curve.label: run.path for run, curve in zip(runs, curves, strict=True)}
    if len(kinds) > 1:
        told = "; ".join(f"{path}: {label}" for label, path in kinds.items())
        raise UsageError(f"these runs minimise different things, which one axis cannot compare: {told}")
    scenes = [_without_seeds(resolve(run.scene)) for run in runs]
    keys = [f"{run.name} {json.dumps(scene, sort_keys=True)}" for run, scene in zip(runs, scenes, strict=True)]
    first = {key: keys.index(key) for key in keys}
    names = group_labels(
        [runs[i].name for i in first.values()],
        [_flat(scenes[i]) for i in first.values()],
        [runs[i].path.resolve().name for i in first.values()],
    )
    return [
        Group(name, tuple(curve for curve, other in zip(curves, keys, strict=True) if other == key))
        for key, name in zip(first, names, strict=True)
    ]


def _without_seeds(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_seeds(item) for key, item in value.items() if key not in ("seed", "title")}
    return value


def _flat(value: Any, path: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {path: value}
    out: dict[str, Any] = {}
    for key, item in value.items():
        out |= _flat(item, f"{path}.{key}" if path else str(key))
    return out


def group_labels(names: Sequence[str], scenes: Sequence[dict[str, Any]], hashes: Sequence[str]) -> list[str]:
    """Return a label for each scene: its name, and what tells it from others of that name."""
    labels = []
    for name, scene, digest in zip(names, scenes, hashes, strict=True):
        rivals = [other for other, same in zip(scenes, names, strict=True) if same == name]
        apart = _differences(scene, rivals)
        if len(rivals) == 1:
            labels.append(name)
        elif 0 < len(apart) <= MOST_DIFFERENCES:
            labels.append(f"{name}, {', '.join(apart)}")
        else:
            labels.append(f"{name} {digest}")
    return labels


def _differences(scene: dict[str, Any], rivals: Sequence[dict[str, Any]]) -> list[str]:
    """Return what a scene has that not all its rivals have; of another optimizer, its name alone."""
    method, methods = _optimizer(scene), {_optimizer(rival) for rival in rivals}
    told = [method] if len(methods) > 1 else []
    for key, value in scene.items():
        if len(methods) > 1 and key.startswith("optimizer."):
            continue
        if any(key not in rival or rival[key] != value for rival in rivals):
            short = ".".join(key.split(".")[-2:])
            told.append(f"{short} {value:g}" if isinstance(value, int | float) else f"{short} {value}")
    return told


def _optimizer(scene: dict[str, Any]) -> str:
    return next((key.split(".")[1] for key in scene if key.startswith("optimizer.")), "")


def _place(curve: LossCurve, over_time: bool) -> Array:
    """Return the iterations of a curve, or the seconds since its first evaluation: compiling is no optimizing."""
    return curve.seconds - curve.seconds[0] if over_time else curve.iteration


def band(group: Group, *, over_time: bool) -> Band:
    """Return mean and confidence interval over a group; a run that has ended stays where it ended."""
    from scipy.special import stdtrit

    places = [_place(curve, over_time) for curve in group.curves]
    end = max(float(place[-1]) for place in places)
    start = min(float(place[0]) for place in places)
    x = np.linspace(start, end, TIMES) if over_time else np.arange(start, end + 1)
    logs = np.array(
        [np.interp(x, p, np.log(np.maximum(c.value, SMALLEST))) for p, c in zip(places, group.curves, strict=True)]
    )
    n = len(group.curves)
    mean = logs.mean(axis=0)
    half = float(stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE)) * logs.std(axis=0, ddof=1) / np.sqrt(n)
    return Band(x, np.exp(mean), np.exp(mean - half), np.exp(mean + half))


# --- drawing ------------------------------------------------------------------------------------------------


def draw_comparison(runs: Sequence[RunData]) -> Figure:
    """Return the picture: loss against iteration, and against wall time."""
    all_groups = groups(runs)
    figure = new_figure(9.0, 3.6)
    by_iteration, by_time = figure.subplots(1, 2, sharey=True)
    for axes, over_time in ((by_iteration, False), (by_time, True)):
        for place, group in enumerate(all_groups):
            _plot_group(axes, group, COLOURS[place % len(COLOURS)], over_time=over_time)
    kind = all_groups[0].curves[0].label
    shown = np.concatenate([np.maximum(c.value, SMALLEST) for group in all_groups for c in group.curves])
    margin = max(float(shown.max() / shown.min()) ** 0.08, 1.05)
    low, high = float(shown.min()) / margin, float(shown.max()) * margin
    by_iteration.set_yscale("log")
    by_iteration.set_ylim(low, high)
    log_ticks(by_iteration.yaxis, low, high)
    whole_ticks(by_iteration.xaxis)
    by_iteration.set_xlabel("iteration")
    by_time.set_xlabel("wall time since the first evaluation (s)")
    titled(by_iteration, f"{capitalised(kind)} (mm)")
    handles, labels = by_iteration.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=min(len(labels), 2))
    return figure


def _plot_group(axes: Axes, group: Group, colour: str, *, over_time: bool) -> None:
    many = len(group.curves) >= BAND_FROM
    for k, curve in enumerate(group.curves):
        x = _place(curve, over_time)
        value = np.maximum(curve.value, SMALLEST)
        label = None if many or k else group.label
        if many:
            axes.plot(x, value, color=colour, linewidth=0.7, alpha=0.35)
        else:
            axes.plot(x, value, color=colour, label=label, marker="o" if len(x) <= 40 else None, markersize=3)
    if many:
        mean = band(group, over_time=over_time)
        text = f"{group.label}: mean of {len(group.curves)} runs, its {100 * CONFIDENCE:.0f} % interval"
        axes.fill_between(mean.x, mean.low, mean.high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(mean.x, mean.mean, color=colour, linewidth=1.8, label=text)

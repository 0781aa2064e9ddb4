"""compare.png: the loss of several runs against iteration and wall time, with a band over those of many seeds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.figures.losses import LossCurve, loss_curve, term_curve, term_names
from cqrun.figures.quantities import time_unit
from cqrun.figures.run_data import RunData
from cqrun.figures.style import COLOURS, log_ticks, new_figure, titled, whole_ticks
from cqrun.fitting.uncertainty import interval_of_mean
from cqrun.plugin.contract import Array
from cqrun.scene.load import resolve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND_FROM = 3
"""Runs that differ in their seeds alone are drawn as mean and band if there are at least so many."""

CONFIDENCE = 0.90
"""Of the band around the mean."""

SMALLEST = 1e-9
"""Losses are not drawn below this on a logarithmic axis, which has no zero."""

BEYOND = 100.0
"""How many times beyond all losses a band is shown on a logarithmic axis: a wide one would squeeze the losses flat."""

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
        seeds: no two of them are the same run again.
    """

    label: str
    curves: tuple[LossCurve, ...]
    seeds: bool = True

    @property
    def log(self) -> bool:
        """Whether their mean is that of logarithms."""
        return all(curve.log for curve in self.curves)


@dataclass(frozen=True)
class Band:
    """Mean over runs with its confidence interval; on a logarithmic axis the geometric mean, that of logarithms.

    x (K,) is iteration or time [s], the rest (K,) in the losses' unit.
    """

    x: Array
    mean: Array
    low: Array
    high: Array


# --- data ---------------------------------------------------------------------------------------------------


def groups(runs: Sequence[RunData], term: str | None = None) -> list[Group]:
    """Return runs grouped by their scenes without seeds, in order of first appearance.

    Args:
        runs: to compare.
        term: of the objective that is compared; the loss if None.

    Raises:
        UsageError: a run has no history yet or no such term, or the runs' losses are not of one kind or are sums of
            different terms.
    """
    curves = [loss_curve(run) if term is None else term_curve(run, term) for run in runs]
    kinds = {curve.title: run.path for run, curve in zip(runs, curves, strict=True)}
    if len(kinds) > 1:
        told = "; ".join(f"{path}: {label}" for label, path in kinds.items())
        raise UsageError(f"these runs minimise different things, which one axis cannot compare: {told}")
    resolved = [resolve(run.scene) for run in runs]
    scenes = [_without_seeds(scene) for scene in resolved]
    if term is None:
        _require_one_objective(runs, [scene.get("objective") or {} for scene in scenes])
    keys = [f"{run.name} {json.dumps(scene, sort_keys=True)}" for run, scene in zip(runs, scenes, strict=True)]
    members = {key: [i for i, other in enumerate(keys) if other == key] for key in dict.fromkeys(keys)}
    names = group_labels(
        [runs[own[0]].name for own in members.values()],
        [_flat(scenes[own[0]]) for own in members.values()],
        [runs[own[0]].path.resolve().name for own in members.values()],
    )
    return [
        Group(
            name,
            tuple(curves[i] for i in own),
            len({json.dumps(resolved[i], sort_keys=True) for i in own}) == len(own),
        )
        for name, own in zip(names, members.values(), strict=True)
    ]


def _require_one_objective(runs: Sequence[RunData], objectives: Sequence[dict[str, Any]]) -> None:
    """Raise a UsageError where losses are sums of different terms; fits to data have none."""
    own = [(run, terms) for run, terms in zip(runs, objectives, strict=True) if run.job != "sysid"]
    other = next(((run, terms) for run, terms in own if terms != own[0][1]), None)
    if other is None:
        return
    names = dict.fromkeys(name for _, terms in (own[0], other) for name in terms)
    apart = [f"objective.{name}" for name in names if own[0][1].get(name) != other[1].get(name)]
    shared = [name for name in names if all(name in term_names(run) for run, _ in own)]
    advice = f"; compare a term that all have with --show TERM: {listed(shared)}" if shared else ""
    raise UsageError(
        "these runs minimise different things, which one axis cannot compare: "
        f"{own[0][0].path} and {other[0].path} differ in {listed(apart)}{advice}"
    )


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
    """Return mean and confidence interval over a group; a run that has ended stays where it ended.

    The mean is the geometric one where the group is drawn on a logarithmic axis.
    """
    places = [_place(curve, over_time) for curve in group.curves]
    end = max(float(place[-1]) for place in places)
    start = min(float(place[0]) for place in places)
    x = np.linspace(start, end, TIMES) if over_time else np.arange(start, end + 1)
    values = [np.log(np.maximum(c.value, SMALLEST)) if group.log else c.value for c in group.curves]
    rows = np.array([np.interp(x, place, value) for place, value in zip(places, values, strict=True)])
    mean, half = interval_of_mean(rows, CONFIDENCE)
    low, high = mean - half, mean + half
    return Band(x, np.exp(mean), np.exp(low), np.exp(high)) if group.log else Band(x, mean, low, high)


# --- drawing ------------------------------------------------------------------------------------------------


def draw_comparison(runs: Sequence[RunData], term: str | None = None) -> Figure:
    """Return the picture: loss, or a term of the objective, against iteration and against wall time."""
    all_groups = groups(runs, term)
    figure = new_figure(9.0, 3.6)
    by_iteration, by_time = figure.subplots(1, 2, sharey=True)
    curves = [curve for group in all_groups for curve in group.curves]
    if all(group.log for group in all_groups):
        low, high = _log_ends(all_groups)
        by_iteration.set_yscale("log")
        by_iteration.set_ylim(low, high)
        log_ticks(by_iteration.yaxis, low, high)
    else:
        all_groups = [replace(group, curves=tuple(replace(c, log=False) for c in group.curves)) for group in all_groups]
    clock = time_unit(max(float(_place(curve, True)[-1]) for curve in curves))
    for axes, over_time in ((by_iteration, False), (by_time, True)):
        for place, group in enumerate(all_groups):
            plot_group(axes, group, COLOURS[place % len(COLOURS)], clock.factor if over_time else None)
    whole_ticks(by_iteration.xaxis)
    by_iteration.set_xlabel("iteration")
    by_time.set_xlabel(clock.label("wall time since the first evaluation"))
    titled(by_iteration, curves[0].title)
    handles, labels = by_iteration.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=min(len(labels), 2))
    return figure


def _log_ends(all_groups: Sequence[Group]) -> tuple[float, float]:
    """Return the ends of a logarithmic axis: every loss is inside, and bands as far as `BEYOND` allows."""
    shown = np.concatenate([np.maximum(curve.value, SMALLEST) for group in all_groups for curve in group.curves])
    bands = [
        band(group, over_time=over_time)
        for group in all_groups
        if len(group.curves) >= BAND_FROM
        for over_time in (False, True)
    ]
    least, most = float(shown.min()), float(shown.max())
    low = max(min([least, *(float(each.low.min()) for each in bands)]), least / BEYOND)
    high = min(max([most, *(float(each.high.max()) for each in bands)]), most * BEYOND)
    margin = max((high / low) ** 0.08, 1.05)
    return low / margin, high * margin


def plot_group(axes: Axes, group: Group, colour: str, clock: float | None) -> None:
    """Draw a group: each run, or their mean and band.

    Args:
        clock: what a second is in the axis' unit, against time; None against iterations.
    """
    count, over_time = len(group.curves), clock is not None
    many = count >= BAND_FROM
    what = f"{count} {'seeds' if group.seeds else 'runs'}"
    factor = clock or 1.0
    for k, curve in enumerate(group.curves):
        x = factor * _place(curve, over_time)
        value = np.maximum(curve.value, SMALLEST) if group.log else curve.value
        label = None if many or k else group.label if count == 1 else f"{group.label}: {what}"
        if many:
            axes.plot(x, value, color=colour, linewidth=0.7, alpha=0.35)
        else:
            axes.plot(x, value, color=colour, label=label, marker="o" if len(x) <= 40 else None, markersize=3)
    if many:
        mean = band(group, over_time=over_time)
        kind = "geometric mean" if group.log else "mean"
        text = f"{group.label}: {kind} of {what} and its {100 * CONFIDENCE:.0f} % interval"
        axes.fill_between(factor * mean.x, mean.low, mean.high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(factor * mean.x, mean.mean, color=colour, linewidth=1.8, label=text)

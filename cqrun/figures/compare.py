"""compare.png: the loss of several runs against iteration and wall time; many seeds are shown as mean and band."""

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
from cqrun.figures.style import COLOURS, legend_label, log_ticks, new_figure, titled, whole_ticks
from cqrun.fitting.uncertainty import interval_of_mean
from cqrun.plugin.contract import Array
from cqrun.scene.load import resolve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND_FROM = 3
"""Smallest number of runs that differ only in their seeds and are drawn as mean and band."""

CONFIDENCE = 0.90
"""Confidence level of the band around the mean."""

SMALLEST = 1e-9
"""Smallest loss on a logarithmic axis, which has no zero."""

BEYOND = 100.0
"""Largest factor between the losses and the end of a logarithmic axis; a wide band must not make the losses flat."""

TIMES = 200
"""Number of points in time at which means are computed."""

MOST_DIFFERENCES, MOST_NAMED = 2, 4
"""If runs of one scene differ in more values than this, their labels have the hash instead; and if each is a line."""


@dataclass(frozen=True)
class Group:
    """Runs that differ only in their seeds.

    Attributes:
        label: name that distinguishes them from the other groups.
        curves: the loss of each run.
        seeds: whether all runs have different seeds, so that no run is a repetition of another.
        names: what distinguishes each run from the others of the group: its seed, or its hash.
    """

    label: str
    curves: tuple[LossCurve, ...]
    seeds: bool = True
    names: tuple[str, ...] = ()

    @property
    def lines(self) -> list[Group]:
        """The group itself if it is drawn as a mean, or else a group for each run, so that each has its own colour."""
        if len(self.curves) == 1 or len(self.curves) >= BAND_FROM or len(self.names) != len(self.curves):
            return [self]
        pairs = zip(self.names, self.curves, strict=True)
        return [Group(f"{self.label}: {name}", (curve,), self.seeds) for name, curve in pairs]

    @property
    def log(self) -> bool:
        """Whether their mean is the mean of logarithms."""
        return all(curve.log for curve in self.curves)


@dataclass(frozen=True)
class Band:
    """Mean over runs with its confidence interval; on a logarithmic axis this is the geometric mean.

    Attributes:
        x: iteration or time [s] (K,).
        mean, low, high: mean and interval, in the unit of the losses (K,).
    """

    x: Array
    mean: Array
    low: Array
    high: Array


# --- data ---------------------------------------------------------------------------------------------------


def groups(runs: Sequence[RunData], term: str | None = None) -> list[Group]:
    """Return runs grouped by their scenes without seeds, in order of first appearance.

    Args:
        runs: the runs to compare.
        term: the term of the objective to compare; the loss if None.

    Raises:
        UsageError: a run has no history yet or no such term, or the losses are of different kinds or sums of different
            terms.
    """
    curves = [loss_curve(run) if term is None else term_curve(run, term) for run in runs]
    kinds = {curve.title: run.path for run, curve in zip(runs, curves, strict=True)}
    if len(kinds) > 1:
        examples = "; ".join(f"{path}: {label}" for label, path in kinds.items())
        raise UsageError(f"these runs minimise different things, which one axis cannot compare: {examples}")
    resolved = [resolve(run.scene) for run in runs]
    scenes = [_without_seeds(scene) for scene in resolved]
    if term is None:
        _require_one_objective(runs, [scene.get("objective") or {} for scene in scenes])
    keys = [f"{run.name} {json.dumps(scene, sort_keys=True)}" for run, scene in zip(runs, scenes, strict=True)]
    members = {key: [i for i, other in enumerate(keys) if other == key] for key in dict.fromkeys(keys)}
    names = group_labels(
        [runs[indices[0]].name for indices in members.values()],
        [_flat(scenes[indices[0]]) for indices in members.values()],
        [runs[indices[0]].path.resolve().name for indices in members.values()],
    )
    return [
        Group(
            name,
            tuple(curves[i] for i in indices),
            len({json.dumps(resolved[i], sort_keys=True) for i in indices}) == len(indices),
            _members([resolved[i].get("seed") for i in indices], [runs[i].path.resolve().name for i in indices]),
        )
        for name, indices in zip(names, members.values(), strict=True)
    ]


def _members(seeds: Sequence[Any], hashes: Sequence[str]) -> tuple[str, ...]:
    """Return a name for each run of a group: its seed, or its hash if runs have the same seed."""
    return tuple(hashes) if len(set(seeds)) < len(seeds) else tuple(f"seed {seed}" for seed in seeds)


def _require_one_objective(runs: Sequence[RunData], objectives: Sequence[dict[str, Any]]) -> None:
    """Raise a UsageError if losses are sums of different terms; fits to data have no terms."""
    learned = [(run, terms) for run, terms in zip(runs, objectives, strict=True) if run.job != "sysid"]
    other = next(((run, terms) for run, terms in learned if terms != learned[0][1]), None)
    if other is None:
        return
    names = dict.fromkeys(name for _, terms in (learned[0], other) for name in terms)
    differences = [f"objective.{name}" for name in names if learned[0][1].get(name) != other[1].get(name)]
    shared = [name for name in names if all(name in term_names(run) for run, _ in learned)]
    advice = f"; compare a term that all have with --show TERM: {listed(shared)}" if shared else ""
    raise UsageError(
        "these runs minimise different things, which one axis cannot compare: "
        f"{learned[0][0].path} and {other[0].path} differ in {listed(differences)}{advice}"
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


def group_labels(
    names: Sequence[str], scenes: Sequence[dict[str, Any]], hashes: Sequence[str], most: int = MOST_DIFFERENCES
) -> list[str]:
    """Return a label for each scene: its name, and its differences from other scenes of that name, or its hash."""
    labels = []
    for name, scene, digest in zip(names, scenes, hashes, strict=True):
        rivals = [other for other, same in zip(scenes, names, strict=True) if same == name]
        differences = _differences(scene, rivals)
        if len(rivals) == 1:
            labels.append(name)
        elif 0 < len(differences) <= most:
            labels.append(f"{name}, {', '.join(differences)}")
        else:
            labels.append(f"{name} {digest}")
    return labels


def run_labels(runs: Sequence[RunData]) -> list[str]:
    """Return a label for each run: its scene, and its differences from other runs of that scene.

    What is measured changes no motion, and the number of substeps follows from other values. So these are named only if
    runs differ in nothing else.
    """
    scenes = [_flat({key: value for key, value in resolve(run.scene).items() if key != "title"}) for run in runs]
    names, hashes = [run.name for run in runs], [run.path.resolve().name for run in runs]
    others = [{k: v for k, v in s.items() if k != "time.substeps" and not k.startswith("measure.")} for s in scenes]
    if len({json.dumps([*each], sort_keys=True) for each in zip(names, others, strict=True)}) == len(runs):
        scenes = others
    return group_labels(names, scenes, hashes, most=MOST_NAMED)


def _differences(scene: dict[str, Any], rivals: Sequence[dict[str, Any]]) -> list[str]:
    """Return the values of a scene that some rivals do not have; for another optimizer only its name."""
    method, methods = _optimizer(scene), {_optimizer(rival) for rival in rivals}
    differences = [method] if len(methods) > 1 else []
    for key, value in scene.items():
        if len(methods) > 1 and key.startswith("optimizer."):
            continue
        if any(key not in rival or rival[key] != value for rival in rivals):
            short = ".".join(key.split(".")[-2:])
            differences.append(f"{short} {value:g}" if isinstance(value, int | float) else f"{short} {value}")
    return differences


def _optimizer(scene: dict[str, Any]) -> str:
    return next((key.split(".")[1] for key in scene if key.startswith("optimizer.")), "")


def _place(curve: LossCurve, over_time: bool) -> Array:
    """Return the iterations of a curve, or the time since its first evaluation, without compile time [s]."""
    return curve.seconds - curve.seconds[0] if over_time else curve.iteration


def band(group: Group, *, over_time: bool) -> Band:
    """Return mean and confidence interval over a group; a run that has ended keeps its last value.

    The mean is geometric if the group is drawn on a logarithmic axis.
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
    """Return the picture: the loss, or a term of the objective, against iteration and wall time."""
    all_groups = [line for group in groups(runs, term) for line in group.lines]
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
    """Return the ends of a logarithmic axis that contains every loss, and bands up to the factor `BEYOND`."""
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
        axes: axes to draw in.
        group: the runs.
        colour: colour of the curves.
        clock: a second in the unit of the time axis; None to draw against iterations.
    """
    count, over_time = len(group.curves), clock is not None
    many = count >= BAND_FROM
    what = f"{count} {'seeds' if group.seeds else 'runs'}"
    factor, name = clock or 1.0, legend_label(group.label)
    for k, curve in enumerate(group.curves):
        x = factor * _place(curve, over_time)
        value = np.maximum(curve.value, SMALLEST) if group.log else curve.value
        label = None if many or k else name if count == 1 else f"{name}: {what}"
        if many:
            axes.plot(x, value, color=colour, linewidth=0.7, alpha=0.35)
        else:
            axes.plot(x, value, color=colour, label=label, marker="o" if len(x) <= 40 else None, markersize=3)
    if many:
        mean = band(group, over_time=over_time)
        kind = "geometric mean" if group.log else "mean"
        text = f"{name}: {kind} of {what} and its {100 * CONFIDENCE:.0f} % interval"
        axes.fill_between(factor * mean.x, mean.low, mean.high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(factor * mean.x, mean.mean, color=colour, linewidth=1.8, label=text)

"""A case: one run of a fit, a rollout or a path of equilibria, and the comparisons of its records with data."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.build.values import collect, numbers
from cqrun.engine.model import Records
from cqrun.errors import CrushedError, NoRestError, RolloutError
from cqrun.fitting.runners import AtRest, InMotion, Runner
from cqrun.measurements.at_rest import RestComparison
from cqrun.measurements.comparison import Comparison
from cqrun.measurements.placement import PLACED, Placement
from cqrun.plugin.contract import Array
from cqrun.running.side_by_side import Effort
from cqrun.scene.keypath import split_own
from cqrun.state import State


@dataclass(frozen=True)
class Case:
    """One run and the comparisons of its records with data.

    Attributes:
        name: name of the recording or sequence.
        built: the scene with this case's overrides; its model records the probe.
        comparisons: one per recording; noisy copies of a sequence share the run.
        start_path: key path of the recording's start, or None.
        start: start of the recording [s].
        placement: of the measured positions in the axes of the scene.
        holdout: whether it is only predicted, never fitted.
        points: the loads of each equilibrium, by key path in its scene; empty for a rollout.

    Values by path may include the recording's own: its start, its placement, and `data.recordings.NAME.overrides.PATH`,
    which has in this case the meaning of PATH.
    """

    name: str
    built: Built
    comparisons: tuple[Comparison, ...]
    start_path: str | None = None
    start: float = 0.0
    placement: Placement | None = None
    holdout: bool = False
    points: tuple[Mapping[str, float], ...] = ()

    @classmethod
    def probed(cls, name: str, built: Built, comparisons: tuple[Comparison, ...], **rest: Any) -> Case:
        """Return the case whose model records what its comparisons need, the same for all."""
        case = cls(name, replace(built, model=replace(built.model, probe=comparisons[0].rows)), comparisons, **rest)
        if not built.model.settled:
            return case
        still = case.runner.still()
        return replace(case, comparisons=tuple(comparison.from_rest(still) for comparison in comparisons))

    # --- values -------------------------------------------------------------------------------------------------

    def own_values(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """Return the values that this case's rollout depends on, by path in its scene.

        The recording's own value of a path replaces the value that all recordings share.
        """
        assembly = self.built.assembly
        own = {inside: values[path] for path, inside in self._own_paths(values)}
        return {path: value for path, value in values.items() if assembly.reaches(path)} | own

    def own_values_vjp(self, values: Mapping[str, Array], own_bar: Mapping[str, Array]) -> dict[str, Array]:
        """Return the gradient by every path of `values` from that by `own_values`."""
        bar = {path: own_bar.get(path, np.zeros(np.shape(value))) for path, value in values.items()}
        for path, inside in self._own_paths(values):
            if inside in values:
                bar[inside] = np.zeros(np.shape(values[inside]))  # this recording does not use it
            bar[path] = own_bar[inside]
        return bar

    def _own_paths(self, values: Mapping[str, Array]) -> list[tuple[str, str]]:
        """Return the recording's own values: the path of each, and its path in the scene of the recording."""
        split = [(path, *split_own(path)) for path in values]
        return [(path, inside) for path, recording, inside in split if recording == self.name]

    def start_of(self, values: Mapping[str, Array]) -> float:
        """Return the recording's start [s]."""
        path = self.start_path
        return self.start if path is None or path not in values else float(values[path])

    def compared(self, values: Mapping[str, Array]) -> tuple[Comparison, ...]:
        """Return the comparisons, with the measured positions in the axes of the scene."""
        placement = self.placed(values)
        return tuple(each.placed(placement) for each in self.comparisons) if placement else self.comparisons

    def placed(self, values: Mapping[str, Array]) -> Placement | None:
        """Return where the axes of the recording lie."""
        if self.placement is None:
            return None
        given = {what: getattr(self.placement, what).tolist() for what in PLACED}
        return Placement(**{what: numbers(f"{self._path}.{what}", given[what], values) for what in PLACED})

    @property
    def _path(self) -> str:
        return f"data.recordings.{self.name}"

    # --- runs ---------------------------------------------------------------------------------------------------

    @property
    def runner(self) -> Runner:
        """What runs its model."""
        (first, *_) = self.comparisons
        names = first.point_names if isinstance(first, RestComparison) else ()
        return AtRest(self.built, self.points, names) if self.points else InMotion(self.built)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Note in errors of a run which recording it belongs to."""
        try:
            yield
        except (RolloutError, NoRestError, CrushedError) as error:
            error.recording = self.name
            raise

    def run(
        self, values: Mapping[str, Array], threads: int = 1, observe: Callable[[int, State], None] | None = None,
        near: Records | None = None,
    ) -> Records:  # fmt: skip
        """Run forward and return the records; call `observe` with the number and the state of each of their rows.

        Args:
            near: records of a run with other values, from whose equilibria a run at rest starts.
        """
        with self._named():
            return self.runner.run(self.own_values(values), threads, observe, near)

    def residuals(self, records: Records, values: Mapping[str, Array]) -> list[Array]:
        """Return the residuals of every comparison."""
        start = self.start_of(values)
        with self._named():
            return [comparison.residuals(records, start) for comparison in self.compared(values)]

    def losses(self, records: Records, values: Mapping[str, Array]) -> Array:
        """Return the loss of every comparison (K,)."""
        start = self.start_of(values)
        return np.array([comparison.loss(records, start) for comparison in self.compared(values)])

    def still_losses(self) -> Array:
        """Return the loss of every comparison for bodies that do not move (K,)."""
        return self.losses(self.runner.still(), {})

    def gradient(
        self, values: Mapping[str, Array], weights: Array, threads: int = 1, budget: int | None = None,
        near: Records | None = None,
    ) -> tuple[float, dict[str, Array], Effort]:  # fmt: skip
        """Return the sum of weights[k] * loss_k, its gradient by path, and the cost."""
        start, comparisons = self.start_of(values), self.compared(values)
        placement = self.placed(values)
        is_wanted = any(path.startswith(f"{self._path}.{what}.") for path in values for what in PLACED)
        loss, start_bar, placement_bars = 0.0, 0.0, list[Placement]()

        def loss_bar(records: Records) -> Records:
            nonlocal loss, start_bar
            total = records.zeros_like()
            for weight, comparison in zip(weights, comparisons, strict=True):
                loss += weight * comparison.loss(records, start)
                bar, by_start = comparison.loss_vjp(records, start, weight)
                start_bar += by_start
                if is_wanted and placement is not None:
                    placement_bars.append(placement.vjp(*comparison.measured_vjp(records, start, weight)))
                total.add(bar)
            return total

        with self._named():
            by_own, effort = self.runner.gradient(self.own_values(values), loss_bar, threads, budget, near)
        gradient = self.own_values_vjp(values, by_own)
        for bar in placement_bars:
            collect(self._path, {what: getattr(bar, what) for what in PLACED}, gradient)
        if self.start_path in gradient:
            gradient[str(self.start_path)] += start_bar
        return loss, gradient, effort

"""A case: one rollout of a fit, and the comparisons of its records with data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.build.values import collect, numbers
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Records
from cqrun.measurements.comparison import Comparison
from cqrun.plugin.contract import Array
from cqrun.running.side_by_side import Effort
from cqrun.scene.keypath import split_own
from cqrun.state import State


@dataclass(frozen=True)
class Case:
    """One rollout and the comparisons of its records with data.

    Attributes:
        name: name of the recording or sequence.
        built: the scene with this case's overrides; its model records the probe.
        comparisons: one per recording; noisy copies of a sequence share the rollout.
        start_path: key path of the recording's start, or None.
        start: start of the recording [s].
        offset: added to the measured positions (D,) [m]; empty if nothing is added.
        holdout: whether it is only predicted, never fitted.

    Values by path may include the recording's own: its start, its offset, and `data.recordings.NAME.overrides.PATH`,
    which has in this case the meaning of PATH.
    """

    name: str
    built: Built
    comparisons: tuple[Comparison, ...]
    start_path: str | None = None
    start: float = 0.0
    offset: Array = field(default_factory=lambda: np.zeros(0))
    holdout: bool = False

    @classmethod
    def probed(cls, name: str, built: Built, comparisons: tuple[Comparison, ...], **rest: Any) -> Case:
        """Return the case whose model records the sums of particles that its comparisons need, the same for all."""
        return cls(name, replace(built, model=replace(built.model, probe=comparisons[0].rows)), comparisons, **rest)

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

    def inputs(self, values: Mapping[str, Array]) -> Inputs:
        """Return the engine's inputs for values by path."""
        return self.built.assembly.inputs(self.own_values(values))

    def start_of(self, values: Mapping[str, Array]) -> float:
        """Return the recording's start [s]."""
        path = self.start_path
        return self.start if path is None or path not in values else float(values[path])

    def compared(self, values: Mapping[str, Array]) -> tuple[Comparison, ...]:
        """Return the comparisons, with the recording's offset added to the measured positions."""
        offset = numbers(self._offset_path, self.offset.tolist(), values)
        return tuple(comparison.moved(offset) for comparison in self.comparisons) if offset.any() else self.comparisons

    @property
    def _offset_path(self) -> str:
        return f"data.recordings.{self.name}.offset"

    # --- runs ---------------------------------------------------------------------------------------------------

    def run(
        self, values: Mapping[str, Array], threads: int = 1, observe: Callable[[int, State], None] | None = None
    ) -> Records:
        """Run forward and return the records; call `observe` with every control step and its state."""
        return make_rollout(self.built.model, self.inputs(values), threads=threads).run(observe)

    def residuals(self, records: Records, values: Mapping[str, Array]) -> list[Array]:
        """Return the residuals of every comparison."""
        start = self.start_of(values)
        return [comparison.residuals(records, start) for comparison in self.compared(values)]

    def losses(self, records: Records, values: Mapping[str, Array]) -> Array:
        """Return the loss of every comparison (K,)."""
        start = self.start_of(values)
        return np.array([comparison.loss(records, start) for comparison in self.compared(values)])

    def still_records(self) -> Records:
        """Return the records of bodies that do not move."""
        model, probe = self.built.model, self.built.model.probe
        assert probe is not None
        shape = (model.n_controls + 1, probe.shape[0], model.dim)
        zeros = np.zeros((*shape, model.dim))
        x = np.broadcast_to(probe @ self.built.particles.x, shape)
        return Records(x, np.zeros(shape), zeros, zeros + np.eye(model.dim))

    def still_losses(self) -> Array:
        """Return the loss of every comparison for bodies that do not move (K,)."""
        return self.losses(self.still_records(), {})

    def gradient(
        self, values: Mapping[str, Array], weights: Array, threads: int = 1, budget: int | None = None
    ) -> tuple[float, dict[str, Array], Effort]:
        """Return the sum of weights[k] * loss_k, its gradient by path, and the cost."""
        model = self.built.model if budget is None else replace(self.built.model, memory_budget=budget)
        start, comparisons, own = self.start_of(values), self.compared(values), self.own_values(values)
        rollout = make_rollout(model, self.built.assembly.inputs(own), threads=threads, adjoint=True)
        offset_is_wanted = any(path.startswith(f"{self._offset_path}.") for path in values)
        loss, start_bar, offset_bar = 0.0, 0.0, np.zeros(len(self.offset))

        def loss_bar(records: Records, final: Any) -> LossBar:
            nonlocal loss, start_bar, offset_bar
            total = records.zeros_like()
            for weight, comparison in zip(weights, comparisons, strict=True):
                loss += weight * comparison.loss(records, start)
                bar, by_start = comparison.loss_vjp(records, start, weight)
                start_bar += by_start
                if offset_is_wanted:
                    offset_bar += comparison.moved_vjp(records, start, weight)
                for out, part in zip(total, bar, strict=True):
                    out += part
                for name, part in bar.history.items():
                    total.history[name] += part
            return LossBar(total)

        _, inputs_bar = rollout.gradient(loss_bar)
        gradient = self.own_values_vjp(values, self.built.assembly.gradient(own, inputs_bar))
        collect(self._offset_path, {"": offset_bar}, gradient)
        if self.start_path in gradient:
            gradient[str(self.start_path)] += start_bar
        return loss, gradient, Effort.of(rollout)

"""A case: one rollout of a fit, and the comparisons of its records with data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Records
from cqrun.measurements.comparison import Comparison
from cqrun.plugin.contract import Array
from cqrun.running.side_by_side import Effort
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
        holdout: whether it is only predicted, never fitted.
    """

    name: str
    built: Built
    comparisons: tuple[Comparison, ...]
    start_path: str | None = None
    start: float = 0.0
    holdout: bool = False

    @classmethod
    def probed(cls, name: str, built: Built, comparisons: tuple[Comparison, ...], **rest: Any) -> Case:
        """Return the case whose model records the sums of particles that its comparisons need, the same for all."""
        return cls(name, replace(built, model=replace(built.model, probe=comparisons[0].rows)), comparisons, **rest)

    def inputs(self, values: Mapping[str, Array]) -> Inputs:
        """Return the engine's inputs for values by path."""
        return self.built.assembly.inputs(values)

    def start_of(self, values: Mapping[str, Array]) -> float:
        """Return the recording's start [s]."""
        path = self.start_path
        return self.start if path is None or path not in values else float(values[path])

    def run(
        self, values: Mapping[str, Array], threads: int = 1, observe: Callable[[int, State], None] | None = None
    ) -> Records:
        """Run forward and return the records; call `observe` with every control step and its state."""
        return make_rollout(self.built.model, self.inputs(values), threads=threads).run(observe)

    def residuals(self, records: Records, values: Mapping[str, Array]) -> list[Array]:
        """Return the residuals of every comparison."""
        start = self.start_of(values)
        return [comparison.residuals(records, start) for comparison in self.comparisons]

    def losses(self, records: Records, start: float) -> Array:
        """Return the loss of every comparison (K,)."""
        return np.array([comparison.loss(records, start) for comparison in self.comparisons])

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
        return self.losses(self.still_records(), self.start)

    def gradient(
        self, values: Mapping[str, Array], weights: Array, threads: int = 1, budget: int | None = None
    ) -> tuple[float, dict[str, Array], Effort]:
        """Return the sum of weights[k] * loss_k, its gradient by path, and the cost."""
        model = self.built.model if budget is None else replace(self.built.model, memory_budget=budget)
        start = self.start_of(values)
        rollout = make_rollout(model, self.inputs(values), threads=threads, adjoint=True)
        loss = start_gradient = 0.0

        def loss_bar(records: Records, final: Any) -> LossBar:
            nonlocal loss, start_gradient
            total = records.zeros_like()
            for weight, comparison in zip(weights, self.comparisons, strict=True):
                loss += weight * comparison.loss(records, start)
                bar, start_bar = comparison.loss_vjp(records, start, weight)
                start_gradient += start_bar
                for out, part in zip(total, bar, strict=True):
                    out += part
                for name, part in bar.history.items():
                    total.history[name] += part
            return LossBar(total)

        _, inputs_bar = rollout.gradient(loss_bar)
        gradient = self.built.assembly.gradient(values, inputs_bar)
        if self.start_path in gradient:
            gradient[str(self.start_path)] += start_gradient
        return loss, gradient, Effort.of(rollout)

"""A case: one rollout of a fit, and what its records are compared with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.engine.model import Inputs, LossBar, Records
from cqrun.engine.rollout import Rollout
from cqrun.measurements.comparison import Comparison
from cqrun.plugin.contract import Array
from cqrun.running.side_by_side import Effort
from cqrun.state import State


@dataclass(frozen=True)
class Case:
    """One rollout and what its records are compared with.

    Attributes:
        name: of the recording or sequence.
        built: the scene with this case's overrides; its model records the probe.
        comparisons: one a recording; copies of one sequence share the rollout.
        start_path: key path of the recording's start, or None.
        start: where it begins [s].
        holdout: predicted, never fitted.
    """

    name: str
    built: Built
    comparisons: tuple[Comparison, ...]
    start_path: str | None = None
    start: float = 0.0
    holdout: bool = False

    @classmethod
    def probed(cls, name: str, built: Built, comparisons: tuple[Comparison, ...], **rest: Any) -> Case:
        """Return the case whose model records what its comparisons ask for: all for the same sums of particles."""
        return cls(name, replace(built, model=replace(built.model, probe=comparisons[0].rows)), comparisons, **rest)

    def inputs(self, values: Mapping[str, Array]) -> Inputs:
        """Return the engine's inputs for values by path."""
        return self.built.assembly.inputs(values)

    def start_of(self, values: Mapping[str, Array]) -> float:
        """Return the recording's start [s]."""
        path = self.start_path
        return self.start if path is None or path not in values else float(values[path])

    def run(
        self,
        values: Mapping[str, Array],
        threads: int = 1,
        observe: Callable[[int, State], None] | None = None,
    ) -> Records:
        """Run forward, `observe` called with every control step and its state; return the records."""
        return Rollout(self.built.model, self.inputs(values), threads=threads).run(observe)

    def residuals(self, records: Records, values: Mapping[str, Array]) -> list[Array]:
        """Return every comparison's residuals."""
        start = self.start_of(values)
        return [comparison.residuals(records, start) for comparison in self.comparisons]

    def losses(self, records: Records, start: float) -> Array:
        """Return every comparison's loss (K,)."""
        return np.array([comparison.loss(records, start) for comparison in self.comparisons])

    def still_records(self) -> Records:
        """Return the records of bodies that stay where they are."""
        model, probe = self.built.model, self.built.model.probe
        assert probe is not None
        shape = (model.n_controls + 1, probe.shape[0], model.dim)
        zeros = np.zeros((*shape, model.dim))
        x = np.broadcast_to(probe @ self.built.particles.x, shape)
        return Records(x, np.zeros(shape), zeros, zeros + np.eye(model.dim))

    def still_losses(self) -> Array:
        """Return every comparison's loss for bodies that stay where they are (K,)."""
        return self.losses(self.still_records(), self.start)

    def gradient(
        self, values: Mapping[str, Array], weights: Array, threads: int = 1, budget: int | None = None
    ) -> tuple[float, dict[str, Array], Effort]:
        """Return sum of weights[k] * loss_k, its gradient by path, and what that cost."""
        model = self.built.model if budget is None else replace(self.built.model, memory_budget=budget)
        start = self.start_of(values)
        rollout = Rollout(model, self.inputs(values), threads=threads, adjoint=True)
        found: dict[str, float] = {"loss": 0.0, "start": 0.0}

        def loss_bar(records: Records, final: Any) -> LossBar:
            total = records.zeros_like()
            for weight, comparison in zip(weights, self.comparisons, strict=True):
                found["loss"] += weight * comparison.loss(records, start)
                bar, start_bar = comparison.loss_vjp(records, start, weight)
                found["start"] += start_bar
                for out, part in zip(total, bar, strict=True):
                    out += part
                for name, part in bar.history.items():
                    total.history[name] += part
            return LossBar(total)

        _, inputs_bar = rollout.gradient(loss_bar)
        gradient = self.built.assembly.gradient(values, inputs_bar)
        if self.start_path in gradient:
            gradient[str(self.start_path)] += found["start"]
        return found["loss"], gradient, Effort.of(rollout)

"""The fit of unknowns to cases as an optimization problem.

    f(x) = loss / unit,   loss = sum over fitted recordings of w_k loss_k / sum w_k,   loss_k = RMSE_k^2

x are the unknowns in scaled coordinates (`design/params.py`), and `unit` is the loss of bodies that do not move. So f
is of order one, and an optimizer's tolerances mean the same in millimetres and in metres. If recordings have different
units, each loss_k is divided by its own such loss. The residuals r are those of the measurements, scaled so that
f = r.r / 2.

Equilibria start from those at the start of the fit, and those of a difference from those beside it. So they are found
soon, and depend on nothing else that was evaluated before: a resumed fit finds the same.

The rollouts of an evaluation run in parallel and share the threads; the results are bit-for-bit identical
for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cqrun.build.assembly import Assembly
from cqrun.design.params import Params
from cqrun.engine.model import Records
from cqrun.errors import NoRestError, Problem, SceneError, UsageError
from cqrun.fitting.case import Case
from cqrun.fitting.uncertainty import Series
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.running.gradient_memory import gradients_at_once
from cqrun.running.side_by_side import Effort, side_by_side, the_value, trial
from cqrun.scene.paths import with_values

DIFFERENCE = 1e-4
"""Step of the forward-difference Jacobian in scaled coordinates, in which the bounds are 1 apart."""


class FitProblem:
    """A `Problem` (optimizers/base.py) over the cases of a scene.

    Args:
        cases: all cases; the held-out ones are not fitted.
        params: the unknowns.
        threads: number of threads.
        interrupt: called before every rollout; it raises StopAsked if the run was asked to stop.

    Attributes:
        unit: loss of bodies that do not move; the square of a cell if that is zero.
        weights: for each case, the weights of its comparisons in the loss; they sum to 1 if all have the same unit.
        effort: cost of the gradients so far.
    """

    stochastic = False

    def __init__(
        self, cases: Sequence[Case], params: Params, *, threads: int = 1, interrupt: Callable[[], None] = lambda: None
    ) -> None:
        self.cases = [case for case in cases if not case.holdout]
        self.params, self.threads = params, threads
        self.start = params.start
        self.lower, self.upper = np.zeros(len(self.start)), np.ones(len(self.start))
        self.n_batches = len(self.cases)
        self.term_names: Sequence[str] = ()
        self.effort = Effort()
        self._kept: dict[tuple[int, bytes], Records] = {}
        self._at_start: dict[str, Records | None] = {}
        self._kept_start: dict[tuple[int, bytes], Records] = {}
        self.interrupt = interrupt
        total = sum(o.weight for case in self.cases for o in case.comparisons)
        still = [case.still_losses() for case in self.cases]
        self.weights = [np.array([o.weight / total for o in case.comparisons]) for case in self.cases]
        if self._of_several_units():
            self.weights = [w / loss for w, loss in zip(self.weights, map(_moving, self.cases, still), strict=True)]
        unit = sum(float(w @ loss) for w, loss in zip(self.weights, still, strict=True))
        self.unit = unit or self.cases[0].built.model.dx ** 2

    @property
    def unit_text(self) -> str:
        """The unit of f as text."""
        return f"{self.unit:.4g} {self.cases[0].built.scene.loss_unit}".rstrip()

    def _of_several_units(self) -> bool:
        scene = self.cases[0].built.scene
        return scene.data is not None and scene.measured is None

    def values(self, x: Array) -> dict[str, Array]:
        """Return the unknowns' values by path."""
        return self.params.unpack(x)

    def require_reached(self, values: Mapping[str, Array]) -> None:
        """Raise UsageError if a recording starts so early that the run ends before its last frames."""
        for case in self.cases:
            for comparison in case.comparisons:
                if wrong := comparison.too_early(case.start_of(values)):
                    raise UsageError(f"{case.start_path}: {wrong}")

    # --- values ---------------------------------------------------------------------------------------------

    def value(self, x: Array, batch: tuple[int, ...] | None = None) -> float:
        """Return f over all cases, or estimated from those in `batch`, by forward rollouts."""
        return the_value(self.values_at([x], batch))

    def values_at(self, points: Sequence[Array], batch: tuple[int, ...] | None = None) -> list[float | TrialFailed]:
        """Return f at every point, or its failed trial; the rollouts run in parallel."""
        chosen, share = self._chosen(batch)
        self._find_starts([self.cases[c] for c in chosen])

        def task(x: Array) -> Callable[[int], float | TrialFailed]:
            def run(threads: int) -> float | TrialFailed:
                self.interrupt()
                try:
                    return sum(share * self._value(self.cases[c], self.weights[c], x, threads) for c in chosen)
                except TrialFailed as failure:
                    return failure

            return run

        return side_by_side([task(x) for x in points], self.threads)

    def _value(self, case: Case, weights: Array, x: Array, threads: int) -> float:
        """Return a case's part of f."""
        values = self.values(x)
        with trial(self.params, x):
            record = case.run(values, threads, near=self._at_start.get(case.name))
        parts = zip(case.residuals(record, values), self._scales(case, weights), strict=True)
        return sum(0.5 * scale**2 * float(np.sum(r**2)) for r, scale in parts)

    def _chosen(self, batch: tuple[int, ...] | None) -> tuple[Sequence[int], float]:
        """Return the cases of a batch, and the factor by which their parts are scaled up."""
        if batch is None:
            return range(self.n_batches), 1.0
        return batch, 1.0 / sum(float(self.weights[c].sum()) for c in batch)

    # --- gradients ------------------------------------------------------------------------------------------

    def value_and_grad(self, x: Array, batch: tuple[int, ...] | None = None) -> tuple[float, Array]:
        """Return f and its gradient (n,) over all cases, or estimated from those in `batch`."""
        values = self.values(x)
        with trial(self.params, x):
            parts, gradient = self.losses_and_gradient(values, batch)
        return float(sum(parts.values())) / self.unit, self.params.gradient(x, gradient) / self.unit

    def losses_and_gradient(
        self, values: Mapping[str, Array], batch: tuple[int, ...] | None = None
    ) -> tuple[dict[str, float], dict[str, Array]]:
        """Return every case's part of the loss, and the gradient of the loss by path, for values by path.

        Raises:
            RolloutError: a case blows up.
        """
        chosen, share = self._chosen(batch)
        moving = [self.cases[c].built.model for c in chosen if not self.cases[c].points]
        at_once = gradients_at_once(moving, self.threads) if moving else self.threads
        self._find_starts([self.cases[c] for c in chosen])

        def task(case: int) -> Callable[[int], tuple[float, dict[str, Array], Effort]]:
            budget = self.cases[case].built.model.memory_budget // at_once

            def run(threads: int) -> tuple[float, dict[str, Array], Effort]:
                self.interrupt()
                near = self._at_start.get(self.cases[case].name)
                return self.cases[case].gradient(values, share * self.weights[case], threads, budget, near)

            return run

        results = side_by_side([task(c) for c in chosen], self.threads, at_once)
        total = {path: np.zeros(np.shape(value)) for path, value in values.items()}
        for _, gradient, effort in results:
            self.effort.add(effort)
            for path in total:
                total[path] = total[path] + gradient[path]
        return {self.cases[c].name: loss for c, (loss, _, _) in zip(chosen, results, strict=True)}, total

    def term_values(self) -> Array:
        """Return no terms: the loss is a single one."""
        return np.zeros(0)

    # --- residuals --------------------------------------------------------------------------------------------

    def residuals(self, x: Array) -> Array:
        """Return r (m,)."""
        return self.residuals_at([x])[0]

    def residuals_at(self, points: Sequence[Array], cases: Sequence[Case] | None = None) -> list[Array]:
        """Return r (m,) at every point; the rollouts run in parallel."""
        cases = self.cases if cases is None else cases
        by_point = [self.values(x) for x in points]
        records = self._records_at(points, by_point, cases)
        scales = [self._scales(case, weights) for case, weights in zip(self.cases, self.weights, strict=True)]
        out = []
        for x, values in zip(points, by_point, strict=True):
            parts = [self._residuals_of(case, x, values, records) for case in cases]
            pairs = ((r, s) for rs, ss in zip(parts, scales, strict=True) for r, s in zip(rs, ss, strict=True))
            out.append(np.concatenate([s * r for r, s in pairs]))
        return out

    def _residuals_of(
        self, case: Case, x: Array, values: Mapping[str, Array], records: Mapping[tuple[int, bytes], Records]
    ) -> list[Array]:
        record = records[self._rollout_key(case, values)]
        with trial(self.params, x):
            return case.residuals(record, values)

    def _rollout_key(self, case: Case, values: Mapping[str, Array]) -> tuple[int, bytes]:
        """Return a key of a rollout: start and offset move only the data, and another recording's values do nothing."""
        moving = [np.asarray(value, float).ravel() for value in case.own_values(values).values()]
        return id(case), np.concatenate([np.zeros(0), *moving]).tobytes()

    def _records_at(
        self, points: Sequence[Array], by_point: Sequence[dict[str, Array]], cases: Sequence[Case]
    ) -> dict[tuple[int, bytes], Records]:
        """Run every rollout that the points need once and return the records; keep those of the first point."""
        wanted = {
            self._rollout_key(case, values): (case, x, values)
            for x, values in zip(points, by_point, strict=True)
            for case in cases
        }
        self._find_starts(cases)
        first = {case.name: self._rollout_key(case, by_point[0]) for case in cases}
        at_rest = [first[case.name] for case in cases if case.points]
        known = self._kept | self._kept_start
        for keys in (at_rest, list(wanted)):
            missing = [key for key in keys if key not in known]
            near = {case.name: known.get(first[case.name], self._at_start.get(case.name)) for case in cases}
            tasks = [self._task(*wanted[key], near[wanted[key][0].name]) for key in missing]
            known |= zip(missing, side_by_side(tasks, self.threads), strict=True)
        self._kept = {key: known[key] for key in first.values()}
        return known

    def _task(self, case: Case, x: Array, values: dict[str, Array], near: Records | None) -> Callable[[int], Records]:
        """Return a task that runs a case at a point."""

        def run(threads: int) -> Records:
            self.interrupt()
            with trial(self.params, x):
                return case.run(values, threads, near=near)

        return run

    def _find_starts(self, cases: Sequence[Case]) -> None:
        """Find the equilibria at the start of the fit of the cases at rest, once; None where there are none."""
        values = self.values(self.start)
        for case in cases:
            if case.points and case.name not in self._at_start:
                self.interrupt()
                try:
                    record = case.run(values, self.threads)
                except NoRestError:
                    self._at_start[case.name] = None
                else:
                    self._at_start[case.name] = self._kept_start[self._rollout_key(case, values)] = record

    def _scales(self, case: Case, weights: Array) -> list[float]:
        """Return the factors of a case's residuals that make f = r.r / 2."""
        return [float(np.sqrt(2.0 * w / (o.count * self.unit))) for w, o in zip(weights, case.comparisons, strict=True)]

    def residuals_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Return r (m,) and J (m, n) by one-sided differences inside the bounds."""
        steps = np.where(x + DIFFERENCE <= self.upper, DIFFERENCE, -DIFFERENCE)
        points = [x, *(x + step * unit for step, unit in zip(steps, np.eye(len(x)), strict=True))]
        r, *moved = self.residuals_at(points)
        return r, np.stack([(m - r) / step for m, step in zip(moved, steps, strict=True)], axis=1)

    def with_half_substep(self) -> FitProblem:
        """Return the same fit with twice the substeps; its residuals show the effect of the substep."""

        def halved(case: Case) -> Case:
            model = case.built.model
            model = replace(model, dt=0.5 * model.dt, substeps=2 * model.substeps)
            return replace(case, built=replace(case.built, model=model))

        return self._with_cases(halved)

    def with_number(self, path: str, value: float) -> FitProblem:
        """Return the same fit with another value of a number that is no unknown."""

        def changed(case: Case) -> Case:
            built = case.built
            scene = with_values(built.scene, {path: value})
            assembly = Assembly(scene, built.particles, built.assembly.sequence)
            return replace(case, built=replace(built, scene=scene, assembly=assembly))

        return self._with_cases(changed)

    def _with_cases(self, change: Callable[[Case], Case]) -> FitProblem:
        cases = [change(case) for case in self.cases]
        other = FitProblem(cases, self.params, threads=self.threads, interrupt=self.interrupt)
        other._at_start = dict(self._at_start)
        return other

    def series(self) -> list[Series]:
        """Return the time series among the residuals."""
        out: list[Series] = []
        begin = recording = 0
        for case, weights in zip(self.cases, self.weights, strict=True):
            for comparison, scale in zip(case.comparisons, self._scales(case, weights), strict=True):
                for part, frames, still in comparison.series():
                    out.append(Series(part + begin, frames, recording, scale * still))
                begin, recording = begin + comparison.size, recording + 1
        return out


def _moving(case: Case, still: Array) -> Array:
    """Return the losses of bodies that do not move; raise SceneError if one is 0, for a recording without motion."""
    if (still == 0).any():
        path = f"data.recordings.{case.name}"
        message = "shows no change, so its errors cannot be compared with those in another unit: remove it"
        raise SceneError([Problem(case.built.scene.where(path), path, message)])
    return still

"""The loss and its terms over a run, from history.csv."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.design.params import REGULARISER
from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.figures.quantities import capitalised
from cqrun.figures.run_data import HISTORY, RunData
from cqrun.optimizers.constrained import CONSTRAINT, KKT, VIOLATION
from cqrun.plugin.contract import Array
from cqrun.store.result import Search
from cqrun.units import Unit

LOSS = "loss"
"""Name of the sum of all terms."""

SPAN = 30.0
"""A positive loss that falls by this factor is drawn on a logarithmic axis."""


@dataclass(frozen=True)
class LossCurve:
    """The loss of a run, or a term of it, over the iterations.

    Attributes:
        label: name of the quantity, such as RMSE.
        iteration, seconds: iteration and time of each row (K,).
        value: value of each row (K,), in `unit`; the root of the loss if the run is fitted to data.
        floor: RMSE caused by the noise of synthetic data alone, in `unit`; None if it is not known. It counts distances
            of markers.
        noise: the noise in each coordinate, as the scene gives it, in `unit`.
        unit: unit of the RMSE, or empty if the objective has its own unit.
        log: whether it is drawn on a logarithmic axis.
        best_row: the row with the best parameters, which the run has kept, if it is not the last row.
    """

    label: str
    iteration: Array
    seconds: Array
    value: Array
    floor: float | None = None
    unit: str = "mm"
    log: bool = True
    best_row: int | None = None
    noise: float = 0.0

    @property
    def title(self) -> str:
        """The name with the unit."""
        return Unit(self.unit, 1.0).label(capitalised(self.label))


def loss_curve(run: RunData) -> LossCurve:
    """Return the loss over a run; raise a UsageError if it has no rows yet."""
    require_rows(run)
    data, loss = run.scene.data, run.history["loss"]
    iteration, seconds = run.history["iteration"], run.history["seconds"]
    if data is None or run.job != "sysid":  # other jobs read no data
        known = loss[np.isfinite(loss)]
        falls = bool(known.size) and float(known.min()) > 0 and float(known.max() / known.min()) >= SPAN
        return LossCurve("loss", iteration, seconds, loss, unit="", log=falls, best_row=_best_row(run))
    measured, floor, noise = run.scene.measured, None, 0.0
    label, shown = ("RMSE", measured.shown) if measured is not None else ("relative RMSE", Unit("", 1.0))
    if data.synthetic is not None and data.synthetic.noise > 0:
        noise = shown.factor * data.synthetic.noise
        floor = noise * float(np.sqrt(run.scene.dim))
    rmse = shown.factor * np.sqrt(np.maximum(loss, 0.0))
    return LossCurve(label, iteration, seconds, rmse, floor, shown.name, best_row=_best_row(run), noise=noise)


def term_names(run: RunData) -> list[str]:
    """Return the terms of a run's loss that its history has, in the order of the scene."""
    return [name for name in [*run.scene.objective, REGULARISER] if np.isfinite(run.history.get(name, np.nan)).any()]


def term_curve(run: RunData, name: str) -> LossCurve:
    """Return a term of the objective, or a measure of the constraints, over a run, in its own unit.

    The measures are the constraints by name, the largest `violation` in units of the scales, and the `kkt` residual.

    Raises:
        UsageError: the history has no rows yet or no such term, or the optimizer reports no terms.
    """
    require_rows(run)
    rows, measures = run.history, [column for column in (VIOLATION, KKT) if column in run.history]
    columns = {each: each for each in (*term_names(run), *measures)}
    columns |= {each: CONSTRAINT + each for each in run.scene.constraints if CONSTRAINT + each in rows}
    if name in run.scene.objective and name in rows and name not in columns:
        optimizer = "" if run.scene.optimizer is None else f" {run.scene.optimizer.name}"
        raise UsageError(
            f"{run.path}: the optimizer{optimizer} reports the loss of every iteration but not its terms, such as "
            f"'{name}'; compare the loss, as `cqrun plot` does without --show"
        )
    if name not in columns:
        names = list(columns)
        known = f"; there are: {listed(names)}" if names else ""
        raise UsageError(f"{run.path}: it has no term or constraint '{name}'{suggest(name, names)}{known}")
    value, log = rows[columns[name]], name in measures
    return LossCurve(name, rows["iteration"], rows["seconds"], value, unit="", log=log, best_row=_best_row(run))


def _best_row(run: RunData) -> int | None:
    loss, best = run.history["loss"], run.result.loss if isinstance(run.result, Search) else None
    rows = np.flatnonzero(loss == (np.nan if best is None else best))
    return int(rows[-1]) if len(rows) and rows[-1] != len(loss) - 1 else None


def require_rows(run: RunData) -> None:
    """Raise a UsageError if the history of a run has no rows yet."""
    if not run.history:
        raise UsageError(f"{run.path}: {HISTORY} is missing or has no rows yet, so there is no convergence to draw")

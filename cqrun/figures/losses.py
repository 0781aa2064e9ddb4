"""The loss and its terms over a run, as history.csv has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.design.params import REGULARISER
from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.figures.quantities import MILLI, Unit, capitalised
from cqrun.figures.run_data import HISTORY, RunData
from cqrun.optimizers.constrained import CONSTRAINT, KKT, VIOLATION
from cqrun.plugin.contract import Array
from cqrun.store.result import Search

LOSS = "loss"
"""What all terms together are called among them."""

SPAN = 30.0
"""A positive loss that falls by this factor is drawn on a logarithmic axis."""


@dataclass(frozen=True)
class LossCurve:
    """The loss of a run, or a term of it, over the iterations.

    Attributes:
        label: what it is, such as RMSE.
        iteration, seconds: of each row (K,).
        value: of each row (K,), in `unit`; of what is fitted to data, the root of the loss.
        floor: RMSE that the noise of synthetic data alone makes [mm]; None where it is not known.
        unit: mm, or nothing where the objective has its own.
        log: it is drawn on a logarithmic axis.
        kept: the row whose parameters the run found best and kept, where that is not the last one.
    """

    label: str
    iteration: Array
    seconds: Array
    value: Array
    floor: float | None = None
    unit: str = "mm"
    log: bool = True
    kept: int | None = None

    @property
    def title(self) -> str:
        """Its name with the unit."""
        return Unit(self.unit, 1.0).label(capitalised(self.label))


def loss_curve(run: RunData) -> LossCurve:
    """Return the loss over a run; UsageError if it has no rows yet."""
    require_rows(run)
    data, loss = run.scene.data, run.history["loss"]
    iteration, seconds = run.history["iteration"], run.history["seconds"]
    if data is None or run.job != "sysid":  # other jobs read none
        known = loss[np.isfinite(loss)]
        falls = bool(known.size) and float(known.min()) > 0 and float(known.max() / known.min()) >= SPAN
        return LossCurve("loss", iteration, seconds, loss, unit="", log=falls, kept=_kept(run))
    label = "distance to the target" if data.target is not None else "RMSE"
    floor = None
    if data.synthetic is not None and data.synthetic.noise > 0:
        floor = MILLI * data.synthetic.noise * float(np.sqrt(run.scene.dim))
    return LossCurve(label, iteration, seconds, MILLI * np.sqrt(np.maximum(loss, 0.0)), floor, kept=_kept(run))


def term_names(run: RunData) -> list[str]:
    """Return the terms of a run's loss that its history tells, in the order of the scene."""
    return [name for name in [*run.scene.objective, REGULARISER] if np.isfinite(run.history.get(name, np.nan)).any()]


def term_curve(run: RunData, name: str) -> LossCurve:
    """Return a term of the objective over a run, or what is known of its constraints, in its own unit.

    Those are the constraints by name, `violation`, the largest in their scales, and `kkt`, the residual.

    Raises:
        UsageError: the history has no rows yet or no such term, or its optimizer tells none.
    """
    require_rows(run)
    rows, judged = run.history, [column for column in (VIOLATION, KKT) if column in run.history]
    columns = {each: each for each in (*term_names(run), *judged)}
    columns |= {each: CONSTRAINT + each for each in run.scene.constraints if CONSTRAINT + each in rows}
    if name in run.scene.objective and name in rows and name not in columns:
        optimizer = "" if run.scene.optimizer is None else f" {run.scene.optimizer.name}"
        raise UsageError(
            f"{run.path}: the optimizer{optimizer} tells the loss of every iteration but not its terms, such as "
            f"'{name}'; compare the loss, which is what `cqrun plot` does without --show"
        )
    if name not in columns:
        names = list(columns)
        known = f"; there are: {listed(names)}" if names else ""
        raise UsageError(f"{run.path}: it has no term or constraint '{name}'{suggest(name, names)}{known}")
    value, log = rows[columns[name]], name in judged
    return LossCurve(name, rows["iteration"], rows["seconds"], value, unit="", log=log, kept=_kept(run))


def _kept(run: RunData) -> int | None:
    loss, found = run.history["loss"], run.result.loss if isinstance(run.result, Search) else None
    rows = np.flatnonzero(loss == (np.nan if found is None else found))
    return int(rows[-1]) if len(rows) and rows[-1] != len(loss) - 1 else None


def require_rows(run: RunData) -> None:
    """Raise a UsageError where a run has no rows of history yet."""
    if not run.history:
        raise UsageError(f"{run.path}: {HISTORY} is missing or has no rows yet, so there is no convergence to draw")

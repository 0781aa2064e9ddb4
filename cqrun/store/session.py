"""The session of an optimizer: its log, state files and history in the run directory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cqrun.errors import UsageError
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.store.replay import ReplayLog
from cqrun.store.run import RunDirectory

MOST_VALUES = 16
"""For blocks with more numbers than this, the history has only the norm of the gradient."""


class RunSession:
    """The `Session` (optimizers/base.py) of a run: log, state files and history on disk.

    The columns of the history are `loss`, the terms, `grad:<block>` (Euclidean norm in scaled coordinates), and
    `value:<block>` (in physical units; followed by `[i]` if the block has several numbers).

    Args:
        run: the run directory, locked by this process.
        seed: seed of the run.
        blocks: slice of each unknown in x, by its key path.
        physical: maps scaled x (n,) to values in SI units (n,).
        term_names: terms of the loss.
        loss_unit: the optimizer's loss of 1, in the unit of the history.
        stop: returns whether the run was asked to stop.
        progress: called with (iteration, x, loss, terms) for each new or repeated row.
    """

    def __init__(
        self,
        run: RunDirectory,
        *,
        seed: int,
        blocks: Mapping[str, slice],
        physical: Callable[[Array], Array],
        term_names: Sequence[str] = (),
        loss_unit: float = 1.0,
        stop: Callable[[], bool] = lambda: False,
        progress: Callable[[int, Array, float, Mapping[str, float]], None] = lambda *_: None,
    ) -> None:
        self.seed = seed
        self._run, self._blocks, self._physical = run, dict(blocks), physical
        self._stop, self._progress, self._unit = stop, progress, loss_unit
        self._labels = {name: _labels(name, part) for name, part in self._blocks.items()}
        self._history = run.history(
            ["loss", *term_names]
            + [f"grad:{name}" for name in self._blocks]
            + [label for labels in self._labels.values() for label in labels]
        )
        self._snapshots = run.snapshots()
        self._log: ReplayLog | None = None

    @property
    def replayed(self) -> int:
        """The number of evaluations that the log has answered."""
        return 0 if self._log is None else self._log.replayed

    @property
    def computed(self) -> int:
        """The number of evaluations that were computed and logged."""
        return 0 if self._log is None else self._log.computed

    def evaluate(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        """Return `compute()`, from the log if it is there; see `ReplayLog.evaluate`."""
        if self._log is None:
            self._log = self._run.replay_log()
        before = self._log.computed
        try:
            return self._log.evaluate(kind, x, compute)
        except TrialFailed as failure:
            if self._log.computed > before:
                self.note(f"failed trial: {failure}")
            raise

    def restore(self) -> dict[str, Array] | None:
        """Return the last saved state, and drop the rows of the history after it.

        Raises:
            UsageError: states or rows are missing, or damaged.
        """
        rows = len(self._history)
        state = self._snapshots.load(rows)
        if state is None and rows > 1:  # a state is saved after each row, and a kill leaves out one
            missing = " and ".join(path.name for path in self._snapshots.paths)
            raise UsageError(
                f"{self._run.path}: {missing} are missing, and history.csv has {rows} rows; start the run over with "
                "--fresh"
            )
        self._history.truncate(0 if state is None else int(state["iteration"]) + 1)
        return state

    def save(self, state: dict[str, Array]) -> None:
        """Save `state` atomically; it replaces the older of the two saved states."""
        self._snapshots.save(state)

    def report(self, iteration: int, x: Array, loss: float, grad: Array, terms: Mapping[str, float]) -> None:
        """Record a row of history.csv; an existing equal row does not change."""
        row = {"loss": self._unit * loss, **{name: self._unit * term for name, term in terms.items()}}
        values = self._physical(x)
        for name, part in self._blocks.items():
            row[f"grad:{name}"] = self._unit * float(np.sqrt(np.sum(grad[part] ** 2)))
            if labels := self._labels[name]:
                row.update(zip(labels, values[part], strict=True))
        self._history.record(iteration, row, self._run.elapsed())
        self._progress(iteration, x, self._unit * loss, terms)

    def note(self, text: str) -> None:
        """Write a line into log.txt."""
        self._run.log(text)

    def should_stop(self) -> bool:
        """Return whether the run was asked to stop."""
        return self._stop()


def _labels(name: str, part: slice) -> list[str]:
    count = part.stop - part.start
    if count > MOST_VALUES:
        return []
    return [f"value:{name}"] if count == 1 else [f"value:{name}[{i}]" for i in range(count)]

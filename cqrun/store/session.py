"""What an optimizer sees of its run directory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.store.replay import ReplayLog
from cqrun.store.run import RunDirectory

SHOWN = 16
"""Blocks with more numbers than this have only the norm of their gradient in the history."""


class RunSession:
    """The `Session` (optimizers/base.py) of a run: log, state files and history on disk.

    The history's columns: `loss`, the terms, `grad:<block>` (Euclidean norm, scaled coordinates), and
    `value:<block>` (physical units; with `[i]` behind it where the block has several numbers).

    Args:
        run: the directory, held by this process.
        seed: of the run.
        blocks: where each unknown stands in x, by its key path.
        physical: from scaled x (n,) to values in SI units (n,).
        term_names: terms of the loss.
        loss_unit: what the optimizer's loss of 1 is in the history's unit.
        stop: whether the run was asked to stop.
        progress: called with (iteration, x, loss, terms) at each new or repeated row.
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
        progress: Callable[[int, Array, float, Mapping[str, float]], None] = lambda *told: None,
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
        """Return how many evaluations the log has answered."""
        return 0 if self._log is None else self._log.replayed

    @property
    def computed(self) -> int:
        """Return how many evaluations were computed and logged."""
        return 0 if self._log is None else self._log.computed

    def evaluate(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        """Return `compute()`, from the log where it is known; see `ReplayLog.evaluate`."""
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
        """Return the last saved state and drop the history's rows behind it."""
        state = self._snapshots.load()
        self._history.truncate(0 if state is None else int(state["iteration"]) + 1)
        return state

    def save(self, state: dict[str, Array]) -> None:
        """Keep `state`, atomically, in place of the last but one."""
        self._snapshots.save(state)

    def report(self, iteration: int, x: Array, loss: float, grad: Array, terms: Mapping[str, float]) -> None:
        """Record a row of history.csv; one that is there already stays as it is."""
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
        """Say whether the run was asked to stop."""
        return self._stop()


def _labels(name: str, part: slice) -> list[str]:
    count = part.stop - part.start
    if count > SHOWN:
        return []
    return [f"value:{name}"] if count == 1 else [f"value:{name}[{i}]" for i in range(count)]

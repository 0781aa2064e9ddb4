"""What runs have left: the columns of their histories, by seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.fitting.uncertainty import interval_of_mean
from cqrun.plugin.contract import Array
from cqrun.store.history import read_history
from cqrun.store.run import FINISHED, read_record

CONFIDENCE = 0.9


@dataclass(frozen=True)
class Run:
    """A run directory with its seed, its history's columns, and whether it has come to its end."""

    path: Path
    seed: int
    history: Mapping[str, Array]
    finished: bool = True

    @property
    def seconds(self) -> Array:
        """Wall time since the first evaluation [s]."""
        return self.history["seconds"] - self.history["seconds"][0]


def runs_below(folder: Path) -> list[Run]:
    """Return all runs below a folder that have a history yet, by seed."""
    found = []
    for file in folder.rglob("history.csv"):
        history = {name: np.array(column) for name, column in read_history(file).items()}
        if history and len(history["iteration"]):
            record = read_record(file.parent)
            found.append(Run(file.parent, int(record["seed"]), history, record["status"] in FINISHED))
    return sorted(found, key=lambda run: run.seed)


def kept(run: Run, term: str) -> float:
    """Return a term of the objective where its loss was least: a run's trajectory is of what it kept."""
    return float(run.history[term][int(np.nanargmin(run.history["loss"]))])


def settled(runs: list[Run]) -> list[Run]:
    """Return the runs that have come to their end or, where none has, all."""
    return [run for run in runs if run.finished] or runs


def rows(variant: str, runs: list[Run], value: Mapping[int, Array]) -> Iterator[dict[str, object]]:
    """Yield rows of a table: variant, seed, iteration, seconds, value; of runs and a value for each seed."""
    for run in runs:
        for k, number in enumerate(value[run.seed]):
            yield {
                "variant": variant,
                "seed": run.seed,
                "iteration": k,
                "seconds": float(run.seconds[k]),
                "value": float(number),
            }


@dataclass(frozen=True)
class Curves:
    """What seeds of one variant have measured.

    Attributes:
        value: (S, K), a row a seed; a seed that has ended stays where it ended.
        seconds: (K,) median wall time since the first evaluation [s].
    """

    value: Array
    seconds: Array

    @property
    def mean(self) -> Array:
        """The mean over seeds (K,)."""
        return np.asarray(self.value.mean(axis=0))

    @property
    def half(self) -> Array:
        """Half the width of the 90 % interval of the mean (K,); 0 of a single seed."""
        if len(self.value) < 2:
            return np.zeros(self.value.shape[1])
        return interval_of_mean(self.value, CONFIDENCE)[1]


def curves(table: Mapping[str, Array], variant: str) -> Curves:
    """Return the curves of a variant from a table of `rows`."""
    own = table["variant"] == variant
    seeds = np.unique(table["seed"][own])
    length = int(table["iteration"][own].max()) + 1
    value, seconds = np.full((len(seeds), length), np.nan), np.full((len(seeds), length), np.nan)
    for row, seed in enumerate(seeds):
        held = own & (table["seed"] == seed)
        for out, column in ((value, "value"), (seconds, "seconds")):
            out[row, : held.sum()] = table[column][held]
            out[row, held.sum() :] = table[column][held][-1]
    return Curves(value, np.median(seconds, axis=0))


def smooth(value: Array, window: int) -> Array:
    """Return means over the last `window` entries, or over as many as there are."""
    total = np.cumsum(np.concatenate([[0.0], value]))
    k = np.arange(1, len(value) + 1)
    first = np.maximum(0, k - window)
    return np.asarray((total[k] - total[first]) / (k - first))


def first_below(value: Array, threshold: float) -> int | None:
    """Return the first place at which a curve is below a threshold."""
    below = np.flatnonzero(value < threshold)
    return int(below[0]) if len(below) else None

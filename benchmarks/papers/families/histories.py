"""What runs have recorded: the columns of their histories, and of their observables."""

from __future__ import annotations

import csv
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
    """A run directory with its seed, its history's columns, and whether it has ended."""

    path: Path
    seed: int
    history: Mapping[str, Array]
    finished: bool = True

    @property
    def seconds(self) -> Array:
        """Wall time since the first evaluation [s]."""
        return self.history["seconds"] - self.history["seconds"][0]

    @property
    def has_trajectory(self) -> bool:
        """Whether its motion is there."""
        return (self.path / "trajectory.h5").exists()

    def at_least_loss(self, term: str) -> float:
        """Return a term of the objective at the iteration with the least loss, whose motion the run keeps."""
        return float(self.history[term][int(np.nanargmin(self.history["loss"]))])


def runs_below(folder: Path) -> list[Run]:
    """Return all runs below a folder that have a history, by seed."""
    runs = []
    for file in folder.rglob("history.csv"):
        history = {name: np.array(column) for name, column in read_history(file).items()}
        if history and len(history["iteration"]):
            record = read_record(file.parent)
            runs.append(Run(file.parent, int(record["seed"]), history, record["status"] in FINISHED))
    return sorted(runs, key=lambda run: run.seed)


def ended_or_all(runs: list[Run]) -> list[Run]:
    """Return the runs that have ended, or all runs if none has."""
    return [run for run in runs if run.finished] or runs


def observables(folder: Path) -> dict[str, Array]:
    """Return the columns of the observables of the only run below a folder; a row for each time."""
    (file,) = folder.rglob("observables.csv")
    with file.open(newline="") as text:
        rows = list(csv.DictReader(text))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def curve_rows(variant: str, run: Run, term: str) -> Iterator[dict[str, object]]:
    """Yield the rows of one curve: variant, seed, iteration, seconds, value of a term of the objective."""
    for k, value in enumerate(run.history[term]):
        seconds = float(run.seconds[k])
        yield {"variant": variant, "seed": run.seed, "iteration": k, "seconds": seconds, "value": float(value)}


@dataclass(frozen=True)
class Curves:
    """The curves of all seeds of one variant.

    Attributes:
        value: (S, K), a row for each seed; a seed that has ended keeps its last value.
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
        """Half the width of the 90 % interval of the mean (K,); 0 for a single seed."""
        if len(self.value) < 2:
            return np.zeros(self.value.shape[1])
        return interval_of_mean(self.value, CONFIDENCE)[1]


def curves(table: Mapping[str, Array], variant: str) -> Curves:
    """Return the curves of a variant from a table of `curve_rows`."""
    of_variant = table["variant"] == variant
    seeds = np.unique(table["seed"][of_variant])
    length = int(table["iteration"][of_variant].max()) + 1
    value, seconds = np.full((len(seeds), length), np.nan), np.full((len(seeds), length), np.nan)
    for row, seed in enumerate(seeds):
        of_seed = of_variant & (table["seed"] == seed)
        for out, column in ((value, "value"), (seconds, "seconds")):
            out[row, : of_seed.sum()] = table[column][of_seed]
            out[row, of_seed.sum() :] = table[column][of_seed][-1]
    return Curves(value, np.median(seconds, axis=0))


def moving_mean(value: Array, window: int) -> Array:
    """Return the mean of the last `window` entries at each place, or of as many as there are."""
    total = np.cumsum(np.concatenate([[0.0], value]))
    k = np.arange(1, len(value) + 1)
    first = np.maximum(0, k - window)
    return np.asarray((total[k] - total[first]) / (k - first))


def first_below(value: Array, threshold: float) -> int | None:
    """Return the first place where a curve is below a threshold, or None."""
    below = np.flatnonzero(value < threshold)
    return int(below[0]) if len(below) else None

"""observables.csv of simulated runs, as columns."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from cqrun.plugin.contract import Array


def observables(folder: Path) -> dict[str, Array]:
    """Return the columns of the one run's observables below a folder; rows of one time a row."""
    (file,) = folder.rglob("observables.csv")
    with file.open(newline="") as text:
        rows = list(csv.DictReader(text))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}

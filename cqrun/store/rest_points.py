"""The points of a path that a run of `rest` has found so far: one file each, so that a killed run goes on."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.store.atomic import write_bytes
from cqrun.store.folder import POINTS, make_below


def write_point(run: Path, number: int, u: Array, facts: dict[str, Any]) -> None:
    """Write the displacement of the nodes (M, 4) at a point, and numbers about how it was found.

    Raises:
        UsageError, RunError: the file cannot be written.
    """
    memory = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(np.nan if value is None else value) for name, value in facts.items()}
    np.savez(memory, u=u, **arrays)
    write_bytes(make_below(run, POINTS) / _name(number), memory.getvalue())


def read_point(run: Path, number: int) -> tuple[Array, dict[str, Any]] | None:
    """Return what `write_point` wrote, or None; a damaged file counts as missing: the point can be found again."""
    file = run / POINTS / _name(number)
    if not file.is_file():
        return None
    try:
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as saved:
            facts = {name: saved[name].item() for name in saved.files if name != "u"}
            return saved["u"], facts
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError):
        return None


def delete_points(run: Path) -> None:
    """Delete the files of all points, which are in the trajectory then."""
    for file in (run / POINTS).glob("*.npz"):
        file.unlink(missing_ok=True)


def _name(number: int) -> str:
    return f"{number:05d}.npz"

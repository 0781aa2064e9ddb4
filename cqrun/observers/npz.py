"""Arrays by name in one file, which is there whole or not at all."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cqrun.errors import UsageError
from cqrun.plugin.contract import Array


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Put arrays at `path`; a reader sees the old file or the new one. OSError where the disk refuses."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_arrays(path: Path, what: str) -> dict[str, Array]:
    """Return the arrays at `path`; nothing in the file is executed.

    Raises:
        UsageError: there is no such file, or it does not hold arrays; `what` says what it should be.
    """
    try:
        with path.open("rb") as file:
            held = np.load(file, allow_pickle=False)
            arrays = dict(held) if isinstance(held, np.lib.npyio.NpzFile) else {}
    except OSError as error:
        raise UsageError(f"{path}: cannot be read as {what}: {error.strerror or error}") from error
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"{path}: is no {what}: not an .npz file of arrays, or a damaged one") from error
    if not arrays or not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise UsageError(f"{path}: is no {what}: it holds no arrays by name")
    return arrays

"""Named arrays in one .npz file, which is written whole or not at all."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cqrun.disk import replacing
from cqrun.errors import UsageError
from cqrun.plugin.contract import Array


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays to `path`, so that a reader sees the old file or the new one; OSError if that fails."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_arrays(path: Path, what: str) -> dict[str, Array]:
    """Read the arrays in the file at `path`; nothing in the file is executed.

    Args:
        what: kind of file for error messages, such as "a controller file".

    Raises:
        UsageError: there is no such file, or it does not contain arrays.
    """
    try:
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            arrays = dict(loaded) if isinstance(loaded, np.lib.npyio.NpzFile) else {}
    except OSError as error:
        raise UsageError(f"{path}: cannot be read as {what}: {error.strerror or error}") from error
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"{path}: is not {what}: it is not an .npz file of arrays, or it is damaged") from error
    if not arrays or not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise UsageError(f"{path}: is not {what}: it contains no named arrays")
    return arrays

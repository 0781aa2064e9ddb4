"""Files that are either there whole or not at all, and disk trouble told in words."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from cqrun.errors import CqrunError, RunError, UsageError

FULL = {errno.ENOSPC, errno.EDQUOT}
REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}
MISPLACED = {errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENOENT, errno.ENAMETOOLONG}


def disk_error(error: OSError, path: Path) -> CqrunError:
    """Return the error that tells a person what `error` on `path` means and what to do."""
    if error.errno in FULL:
        return RunError(
            f"{path}: the disk is full; nothing written before is lost. "
            "Free some space, then `cqrun resume` the run, or choose another disk with --out"
        )
    if error.errno in REFUSED:
        return UsageError(f"{path}: cannot be written ({error.strerror}); choose another place with --out")
    if error.errno in MISPLACED:
        return UsageError(f"{path}: cannot be made ({error.strerror}); choose another place with --out")
    return RunError(f"{path}: cannot be written ({error.strerror or error})")


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn an OSError inside the block into cqrun's own error about `path`."""
    try:
        yield
    except OSError as error:
        raise disk_error(error, path) from error


def make_directory(path: Path) -> None:
    """Make a directory and its parents; one that exists is fine.

    Raises:
        UsageError: it cannot be made there.
        RunError: the disk is full.
    """
    with disk_errors(path):
        path.mkdir(parents=True, exist_ok=True)


def require_room(path: Path, size: int) -> None:
    """Refuse to begin a file of `size` bytes at `path` where the disk has no room for it.

    For files that a library writes which cannot cope with a full disk: HDF5 crashes the process. Where the system
    cannot reserve room (macOS), nothing is checked.

    Raises:
        UsageError: the directory cannot be written to.
        RunError: the disk is full.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    trial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with disk_errors(path):
        try:
            with trial.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, max(size, 1))
        finally:
            trial.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the name to write a file under; what is there takes the place of `path` when the block ends well.

    A reader sees the old file or the new one, whole, also after a crash; a block that fails leaves nothing.

    Raises:
        UsageError: the directory cannot be written to.
        RunError: the disk is full, or failed.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with disk_errors(path):
        try:
            yield temporary
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_directory(path.parent)


def write_bytes(path: Path, data: bytes) -> None:
    """Put `data` at `path`, whole or not at all; see `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Put UTF-8 `text` at `path`; see `write_bytes`."""
    write_bytes(path, text.encode())


def write_table(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Put rows at `path` as CSV; numbers come back to the bit, None is an empty cell. See `write_bytes`."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_text(path, text.getvalue())


def write_json(path: Path, value: Any) -> None:
    """Put `value` at `path` as indented JSON; NaN and infinities are refused, as JSON has none.

    Raises:
        ValueError: a number is not finite.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def append_durably(file: io.FileIO, data: bytes) -> None:
    """Write `data` at the position of an unbuffered file, all of it, and wait until the disk has it.

    Unbuffered, because a buffer that met a full disk would try again when the file is closed.
    """
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]
    os.fsync(file.fileno())


def sync_directory(directory: Path) -> None:
    """Make a rename or a new file in `directory` last through a power cut."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that cannot sync a directory does not need it
            raise
    finally:
        os.close(handle)

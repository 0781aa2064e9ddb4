"""Write files atomically (complete or not at all), and turn disk errors into clear messages."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

from cqrun import disk
from cqrun.errors import CqrunError, RunError, UsageError

FULL = {errno.ENOSPC, errno.EDQUOT}
REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}
MISPLACED = {errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENOENT, errno.ENAMETOOLONG}


def disk_error(error: OSError, path: Path) -> CqrunError:
    """Return the error that explains `error` on `path`, and what to do about it."""
    if error.errno in FULL:
        return RunError(
            f"{path}: the disk is full; nothing written before is lost. Free some space and give the same command "
            "again, or choose another disk with --out"
        )
    if error.errno in REFUSED:
        return UsageError(f"{path}: cannot be written ({error.strerror}); choose another place with --out")
    if error.errno in MISPLACED:
        return UsageError(f"{path}: cannot be made ({error.strerror}); choose another place with --out")
    return RunError(f"{path}: cannot be written ({error.strerror or error})")


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn an OSError inside the block into one of cqrun's errors about `path`."""
    try:
        yield
    except OSError as error:
        raise disk_error(error, path) from error


def make_directory(path: Path) -> None:
    """Make a directory and its parents, unless they exist.

    Raises:
        UsageError: it cannot be made there.
        RunError: the disk is full.
    """
    with disk_errors(path):
        path.mkdir(parents=True, exist_ok=True)


def require_room(path: Path, size: int) -> None:
    """Raise an error if the disk has no space for a file of `size` bytes at `path`.

    Needed for libraries that cannot handle a full disk: HDF5 crashes the process. On systems that cannot reserve space
    (macOS) nothing is checked.

    Raises:
        UsageError: the directory cannot be written to.
        RunError: the disk is full.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    trial = disk.temporary_of(path)
    with disk_errors(path):
        try:
            disk.make_empty(trial)
            with trial.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, max(size, 1))
        finally:
            trial.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield an empty temporary file to write to, which then replaces `path`, completely or not at all.

    Raises:
        UsageError: the directory cannot be written to.
        RunError: the disk is full, or failed.
    """
    with disk_errors(path), disk.replacing(path) as temporary:
        yield temporary


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`, completely or not at all; see `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8; bytes of file names that are none become `\\udcXX`. See `write_bytes`."""
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_table(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Write rows to `path` as CSV, with exact numbers and None as an empty cell; see `write_bytes`."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_text(path, text.getvalue())


def write_json(path: Path, value: Any) -> None:
    """Write `value` to `path` as indented JSON; NaN and infinities are refused, because JSON does not have them.

    Raises:
        ValueError: a number is not finite.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def append_durably(file: IO[bytes], data: bytes) -> None:
    """Write all of `data` at the position of an unbuffered file, and wait until it is on disk.

    The file must be unbuffered, because after an error on a full disk a buffer would be written again on closing.
    """
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]
    os.fsync(file.fileno())

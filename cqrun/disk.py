"""Files and folders that are opened and made without following a link.

The name of every file of a run is known beforehand, and a folder of results may come from a stranger. So a link may lie
where cqrun is about to write, and point to a file of the user's own. Nothing here follows a link in the last part of a
path; store/folder.py checks the folders above it. Files that the user names may be links, and are opened elsewhere.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from cqrun.errors import UsageError

AS_IT_IS = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
"""Flags with which a link is an error, and a pipe does not wait for its other end."""

NOT_OPENED = {errno.ELOOP, errno.EMLINK, errno.ENXIO}
"""What opening a link, or a pipe that nobody reads, fails with."""


def open_descriptor(path: Path, flags: int) -> int:
    """Open an ordinary file and return its descriptor.

    Raises:
        UsageError: it is a link or no ordinary file, or would be written to and has a second name.
        OSError: it cannot be opened.
    """
    try:
        handle = os.open(path, (flags & ~os.O_TRUNC) | AS_IT_IS, 0o666)
    except OSError as error:
        if error.errno in NOT_OPENED:
            require_ordinary(path)
        raise
    try:
        found, writes = os.fstat(handle), bool(flags & (os.O_WRONLY | os.O_RDWR))
        if not stat.S_ISREG(found.st_mode):
            raise UsageError(_not_ordinary(path, found.st_mode))
        if writes and found.st_nlink > 1:
            raise UsageError(
                f"{path}: is the same file as another (a hard link), which would be changed with it; put a copy here"
            )
        if flags & os.O_TRUNC:
            os.ftruncate(handle, 0)
    except BaseException:
        os.close(handle)
        raise
    return handle


def open_file(path: Path, mode: str = "rb", **options: Any) -> IO[Any]:
    """Open an ordinary file as `open` does; arguments as there, errors as `open_descriptor`."""
    return open(path, mode, opener=lambda name, flags: open_descriptor(path, flags), **options)


def require_ordinary(path: Path, *, folder: bool = False) -> None:
    """Refuse a link, and anything else that is no ordinary file; what does not exist passes.

    Args:
        folder: whether a folder is wanted in place of a file.

    Raises:
        UsageError: it is something else.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not (stat.S_ISDIR(mode) if folder else stat.S_ISREG(mode)):
        raise UsageError(_not_ordinary(path, mode, "folder" if folder else "file"))


def _not_ordinary(path: Path, mode: int, wanted: str = "file") -> str:
    if stat.S_ISLNK(mode):
        return f"{path}: is a link to {path.readlink()}, and cqrun follows no links in its results; move it away"
    return f"{path}: is not an ordinary {wanted}; move it away"


def make_empty(path: Path) -> None:
    """Make an empty file; whatever was there under its name is removed, and nothing behind a link is touched.

    Raises:
        OSError: it cannot be made.
    """
    path.unlink(missing_ok=True)
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | AS_IT_IS, 0o666))


def temporary_of(path: Path) -> Path:
    """Return the name under which a file is written before it takes its place."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield an empty temporary file to write to; when the block ends without an error, it replaces `path`.

    A reader sees either the complete old file or the complete new one, even after a crash. A block that fails leaves no
    file.

    Raises:
        OSError: it cannot be written.
    """
    temporary = temporary_of(path)
    try:
        make_empty(temporary)
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    sync_directory(path.parent)


def sync_directory(directory: Path) -> None:
    """Make a rename or a new file in `directory` durable, even after a power cut."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that cannot sync a directory does not need it
            raise
    finally:
        os.close(handle)

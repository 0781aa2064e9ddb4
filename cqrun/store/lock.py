"""Locks on run directories: only one process at a time works on a run."""

from __future__ import annotations

import fcntl
import os
import socket
from pathlib import Path

from cqrun.errors import UsageError
from cqrun.store.atomic import disk_errors


def is_locked(directory: Path) -> bool:
    """Return whether a process holds the lock of a run directory at this moment."""
    try:
        handle = os.open(directory / "lock", os.O_RDONLY)
    except OSError:
        return False  # no run here yet
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False


class DirectoryLock:
    """An advisory lock (flock) on the file `lock`; it ends when the process ends, for whatever reason.

    The file is not removed: otherwise two processes could lock two different files of the same name.

    Args:
        directory: the run directory; it must exist.

    Raises:
        UsageError: another process holds the lock; the message names its pid.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / "lock"
        with disk_errors(self.path):
            self._handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            self._take(directory)
        except BaseException:
            os.close(self._handle)
            raise

    def _take(self, directory: Path) -> None:
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(self._handle, 256, 0).decode(errors="replace").strip() or "unknown"
            raise UsageError(
                f"{directory}: another process works on this run (pid {holder}); "
                "wait for it or stop it, or give --out DIR for a run of your own"
            ) from error
        with disk_errors(self.path):
            os.ftruncate(self._handle, 0)
            os.pwrite(self._handle, f"{os.getpid()} on {socket.gethostname()}\n".encode(), 0)

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

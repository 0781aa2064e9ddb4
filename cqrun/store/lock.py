"""Locks on run directories: only one process at a time works on a run, where the file system has locks."""

from __future__ import annotations

import fcntl
import os
import socket
from pathlib import Path

from cqrun.disk import open_descriptor
from cqrun.errors import UsageError
from cqrun.store.atomic import disk_errors
from cqrun.store.folder import LOCK


def is_locked(directory: Path) -> bool:
    """Return whether a process holds the lock of a run directory at this moment."""
    try:
        handle = open_descriptor(directory / LOCK, os.O_RDONLY)
    except (OSError, UsageError):
        return False  # no run here yet
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False  # no locks here
    finally:
        os.close(handle)
    return False


class DirectoryLock:
    """An advisory lock (flock) on the file `lock`; it ends when the process ends, for whatever reason.

    The file is not removed: otherwise two processes could lock two different files of the same name.

    Args:
        directory: the run directory; it must exist.

    Attributes:
        works: whether it keeps other processes away; False on a file system without locks, as some of clusters are.

    Raises:
        UsageError: another process holds the lock; the message names its pid.
    """

    def __init__(self, directory: Path) -> None:
        self.path, self.works = directory / LOCK, True
        with disk_errors(self.path):
            self._handle = open_descriptor(self.path, os.O_RDWR | os.O_CREAT)
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
        except OSError:
            self.works = False
        with disk_errors(self.path):
            os.ftruncate(self._handle, 0)
            os.pwrite(self._handle, f"{os.getpid()} on {socket.gethostname()}\n".encode(), 0)

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

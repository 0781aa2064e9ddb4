"""File systems without locks: a run goes on, and says that nothing keeps a second process away."""

from __future__ import annotations

import errno
import fcntl
import os

import pytest
from small_beam import Listener

from cqrun.errors import UsageError
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.running import kernels
from cqrun.store.lock import DirectoryLock, is_locked

NO_LOCKS = [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, errno.EIO]
SHORT = ["time.duration=0.02"]
TOLD = "this file system has no locks, so nothing keeps a second process away: run only one"


@pytest.fixture
def without_locks(monkeypatch):
    """Return a function that lets flock fail, as NFS and Lustre do where locks are not set up."""

    def fail_with(number: int) -> None:
        def flock(handle, flags):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(fcntl, "flock", flock)

    return fail_with


@pytest.mark.parametrize("number", NO_LOCKS)
def test_a_run_without_locks_goes_on_and_says_so(beam, tmp_path, without_locks, number):
    without_locks(number)
    listener = Listener()
    run = run_simulate(beam, SHORT, tmp_path, threads=1, reporter=listener)
    assert f"warning: {run}: {TOLD}" in listener.said
    assert (run / "lock").read_text().startswith(f"{os.getpid()} on ")
    assert not is_locked(run)
    listener = Listener()
    run_resume(run, [], threads=1, reporter=listener)
    assert f"warning: {run}: {TOLD}" in listener.said


def test_a_lock_that_works_is_not_spoken_of(beam, tmp_path):
    listener = Listener()
    run = run_simulate(beam, SHORT, tmp_path, threads=1, reporter=listener)
    assert not any("locks" in line for line in listener.said)
    lock = DirectoryLock(run)
    assert lock.works
    assert is_locked(run)
    with pytest.raises(UsageError, match="another process works on this run"):
        DirectoryLock(run)
    lock.release()


def test_what_the_cache_could_not_do_is_told_once(beam, tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "CACHE_PROBLEMS", {"the cache is full": True})
    listener = Listener()
    run_simulate(beam, SHORT, tmp_path, threads=1, reporter=listener)
    assert listener.said.count("warning: the cache is full") == 1
    assert not kernels.CACHE_PROBLEMS

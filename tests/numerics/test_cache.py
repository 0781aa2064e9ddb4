"""The cache of compiled kernels: without locks, without room, and damaged."""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest
from numba import config

from cqrun.numerics import compile as compiling
from cqrun.numerics.compile import SharedIndex


@pytest.fixture
def index(tmp_path):
    """Return the index of a kernel in an empty cache."""
    return SharedIndex(str(tmp_path), "kernel", "stamp")


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, errno.EIO])
def test_a_kernel_is_kept_where_the_cache_has_no_locks(index, tmp_path, monkeypatch, number):
    def flock(handle, flags):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(compiling, "CACHE_PROBLEMS", {})
    monkeypatch.setattr(fcntl, "flock", flock)
    index.save("key", b"code")
    assert SharedIndex(str(tmp_path), "kernel", "stamp").load("key") == b"code"
    (told,) = compiling.CACHE_PROBLEMS
    assert "this file system has no locks, so nothing keeps two processes apart that compile at once" in told


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT])
def test_a_cache_that_cannot_be_written_costs_time_only(index, monkeypatch, number):
    monkeypatch.setattr(compiling, "CACHE_PROBLEMS", {})

    def fail(*arguments):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(index, "_save_data", fail)
    index.save("key", b"code")
    (told,) = compiling.CACHE_PROBLEMS
    assert f"compiled kernels cannot be kept here ({os.strerror(number)}), so the next process compiles them" in told


@pytest.mark.parametrize("suffix", [".nbi", ".1.nbc"])
@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"half a pickle"])
def test_a_damaged_cache_is_compiled_again(index, tmp_path, suffix, content):
    """As after a power cut."""
    index.save("key", b"code")
    (tmp_path / f"kernel{suffix}").write_bytes(content)
    again = SharedIndex(str(tmp_path), "kernel", "stamp")
    assert again.load("key") is None
    again.save("key", b"code")
    assert SharedIndex(str(tmp_path), "kernel", "stamp").load("key") == b"code"


def test_kernels_of_a_file_whose_path_is_not_utf8_are_kept(tmp_path, monkeypatch):
    """A plug-in of a user may lie anywhere."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    (folder / "law.py").write_text("def twice(x):\n    return 2.0 * x\n")
    module = ModuleType("law_of_a_user")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(compiling, "_KERNELS", [])
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    exec(compile((folder / "law.py").read_bytes(), str(folder / "law.py"), "exec"), vars(module))
    assert compiling.kernel(module.twice)(2.0) == 4.0
    again = compiling.kernel(module.twice)
    assert again(3.0) == 6.0
    assert config.DISABLE_JIT or again.stats.cache_hits


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_without_any_folder_for_the_cache_kernels_are_compiled_in_each_process(monkeypatch):
    monkeypatch.setattr(compiling, "CACHE_PROBLEMS", {})
    monkeypatch.setattr(compiling, "_KERNELS", [])
    monkeypatch.setattr(compiling.caching.CompileResultCacheImpl, "_locator_classes", [])

    def twice(x):
        return 2.0 * x

    assert compiling.kernel(twice)(2.0) == 4.0
    (told,) = compiling.CACHE_PROBLEMS
    assert "no folder for compiled kernels can be written" in told

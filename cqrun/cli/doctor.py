"""`cqrun doctor`: is this machine fit to run cqrun, and what would it use?"""

from __future__ import annotations

import os
import platform
import re
import sys
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import typer

from cqrun.cli.options import DEFAULT_OUT, Out
from cqrun.fingerprint import engine_hash
from cqrun.version import __version__

REQUIREMENT = re.compile(r"""^([A-Za-z0-9_.-]+)[^;]*(?:;.*extra\s*==\s*['"]([^'"]+)['"])?""")


def doctor(out: Out = DEFAULT_OUT) -> None:
    """Print versions, cores, threads and directories, and run a test kernel; exit 1 if something fails."""
    from cqrun.running.selfcheck import check_kernel

    failures = 0
    for name, value in _machine():
        _say(name, value)
    for name, value in _packages():
        _say(name, value)
    cache = os.environ.get("NUMBA_CACHE_DIR", "")
    for name, folder in (("kernel cache", Path(cache)), ("results", out)):
        problem = _unwritable(folder)
        failures += bool(problem)
        _say(name, f"{folder}: {problem or 'writable'}")
    threads = _cores()
    kernel = check_kernel(threads)
    failures += not kernel.right
    _say("threads", f"{threads}, met by the engine's own barrier")
    _say(
        "test kernel",
        f"{'right' if kernel.right else 'WRONG RESULT'}, {kernel.origin}, {kernel.seconds:.2f} s",
    )
    if failures:
        raise typer.Exit(1)


def _say(name: str, value: str) -> None:
    typer.echo(f"{name:20} {value}")


def _machine() -> Iterator[tuple[str, str]]:
    import psutil

    memory = psutil.virtual_memory()
    yield "cqrun", __version__
    yield "engine", engine_hash()
    yield "Python", f"{sys.version.split()[0]} on {platform.platform()}"
    yield "cores", f"{_cores()} usable, {psutil.cpu_count(logical=False)} physical in all"
    yield "load", " ".join(f"{value:.1f}" for value in psutil.getloadavg()) + " (1, 5, 15 minutes)"
    yield "memory", f"{memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GiB free"


def _cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _packages() -> Iterator[tuple[str, str]]:
    """Yield each dependency with its version; those of an extra say so, absent ones too."""
    try:
        required = metadata.requires("cqrun") or []
    except metadata.PackageNotFoundError:
        yield "packages", "cqrun is not installed here (`make setup` does it)"
        return
    for text in required:
        match = REQUIREMENT.match(text)
        if match is None:
            raise AssertionError(f"a requirement that cannot be read: {text}")
        name, extra = match.groups()
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            version = "absent"
        yield name, version + (f" (extra '{extra}')" if extra else "")


def _unwritable(folder: Path) -> str:
    """Return why no file can be written into a folder, or below its nearest existing parent; else nothing."""
    if not folder.parts:
        return "not set"
    nearest = next((f for f in (folder, *folder.absolute().parents) if f.exists()), folder)
    try:
        with tempfile.TemporaryFile(dir=nearest):
            return ""
    except OSError as error:
        return f"NOT WRITABLE ({error.strerror})"

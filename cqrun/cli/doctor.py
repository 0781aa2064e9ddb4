"""`cqrun doctor`: check that this machine can run cqrun, and show what cqrun uses."""

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

from cqrun.cli.options import Out
from cqrun.cli.terminal import echo
from cqrun.fingerprint import engine_hash
from cqrun.store.places import DEFAULT_OUT
from cqrun.version import __version__

REQUIREMENT = re.compile(r"""^([A-Za-z0-9_.-]+)[^;]*(?:;.*extra\s*==\s*['"]([^'"]+)['"])?""")


def doctor(out: Out = None) -> None:
    """Print versions, cores, threads and directories, and run a test kernel; exit 1 if something fails."""
    from cqrun.running.selfcheck import check_kernel
    from cqrun.running.threads import cores

    failures = 0
    for name, value in _machine():
        _print(name, value)
    for name, value in _packages():
        _print(name, value)
    cache = os.environ.get("NUMBA_CACHE_DIR", "")
    for name, folder in (("kernel cache", Path(cache)), ("results", out or DEFAULT_OUT)):
        problem = _write_problem(folder)
        failures += bool(problem)
        _print(name, f"{folder}: {problem or 'writable'}")
    threads = cores(None)
    kernel = check_kernel(threads)
    failures += not kernel.right
    _print("threads", f"{threads}, synchronised by the engine's barrier")
    _print(
        "test kernel",
        f"{'right' if kernel.right else 'WRONG RESULT'}, {kernel.origin}, {kernel.seconds:.2f} s",
    )
    if failures:
        raise typer.Exit(1)


def _print(name: str, value: str) -> None:
    echo(f"{name:20} {value}")


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
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _packages() -> Iterator[tuple[str, str]]:
    """Yield each dependency with its version or `absent`, and the extra that it belongs to."""
    try:
        required = metadata.requires("cqrun") or []
    except metadata.PackageNotFoundError:
        yield "packages", "cqrun is not installed here (`make setup` does it)"
        return
    for text in required:
        match = REQUIREMENT.match(text)
        if match is None:
            raise AssertionError(f"this requirement cannot be parsed: {text}")
        name, extra = match.groups()
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            version = "absent"
        yield name, version + (f" (extra '{extra}')" if extra else "")


def _write_problem(folder: Path) -> str:
    """Return why a folder, or its nearest existing parent, cannot be written to; empty if it can."""
    if not folder.parts:
        return "not set"
    nearest = next((f for f in (folder, *folder.absolute().parents) if f.exists()), folder)
    try:
        with tempfile.TemporaryFile(dir=nearest):
            return ""
    except OSError as error:
        return f"NOT WRITABLE ({error.strerror})"

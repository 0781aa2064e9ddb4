"""The provenance of a result: versions of the software, the git commit, the machine and the time."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cqrun.fingerprint import library_versions
from cqrun.version import __version__


def versions() -> dict[str, str]:
    """Return the versions of cqrun, Python and the libraries that compute."""
    return {"cqrun": __version__, "python": platform.python_version(), **library_versions()}


def now() -> str:
    """Return the time in UTC, such as `2026-05-04T12:30:00+00:00`."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def machine() -> dict[str, Any]:
    """Return facts about this machine: its processor, its number of cores, and its operating system."""
    return {"processor": _processor(), "cores": os.cpu_count(), "system": platform.platform()}


def _processor() -> str:
    """Return the name of the processor; empty if the system does not say it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def git_state(package: Path = Path(__file__).parents[1]) -> dict[str, Any] | None:
    """Return the commit of the checkout that contains `package`, and whether files have changed since.

    Returns:
        {"commit": 40 hex digits, "dirty": bool}, or None if there is no checkout or no git.
    """
    if not (package.parent / ".git").exists():
        return None
    try:
        commit = _git(package, "rev-parse", "HEAD")
        changes = _git(package, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):  # no git, or a repository that git does not trust
        return None
    return {"commit": commit, "dirty": bool(changes)}


def _git(directory: Path, *command: str) -> str:
    return subprocess.run(
        ["git", "-C", str(directory), *command], capture_output=True, text=True, check=True, timeout=10
    ).stdout.strip()

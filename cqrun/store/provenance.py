"""The provenance of a result: versions of the software and the git commit."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path
from typing import Any

from cqrun.fingerprint import library_versions
from cqrun.version import __version__


def versions() -> dict[str, str]:
    """Return the versions of cqrun, Python and the libraries that compute."""
    return {"cqrun": __version__, "python": platform.python_version(), **library_versions()}


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

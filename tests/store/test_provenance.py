"""The commit of a checkout, or None without a checkout."""

from __future__ import annotations

import subprocess

from cqrun.store.provenance import git_state


def git(directory, *command):
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    subprocess.run(["git", "-C", str(directory), *identity, *command], check=True, capture_output=True)


def test_commit_and_changes(tmp_path):
    package = tmp_path / "cqrun"
    package.mkdir()
    assert git_state(package) is None
    git(tmp_path, "init")
    assert git_state(package) is None  # no commit yet
    (package / "a.py").write_text("a = 1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    state = git_state(package)
    assert len(state["commit"]) == 40
    assert state["dirty"] is False
    (package / "a.py").write_text("a = 2\n")
    assert git_state(package) == {"commit": state["commit"], "dirty": True}

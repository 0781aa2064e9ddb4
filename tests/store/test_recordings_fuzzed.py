"""Recordings with one to four changed bytes are read or refused: no traceback, no crash, little memory and time."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the limit of memory needs Linux")

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).with_name("fuzz_recordings.py")


def fuzz(kind: str, count: int, seed: int) -> tuple[int, int]:
    """Return how many changed files were read, and how many refused."""
    path = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    done = subprocess.run(
        [sys.executable, str(SCRIPT), kind, str(count), str(seed)],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}, timeout=60 + 0.5 * count,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.returncode}: {done.stdout}\n{done.stderr}"
    shutil.rmtree(done.stdout.splitlines()[0])
    numbers = re.search(r"files: (\d+) read, (\d+) refused", done.stdout)
    assert numbers is not None
    return int(numbers[1]), int(numbers[2])


@pytest.mark.parametrize("kind", ["c3d", "csv", "h5"])
def test_changed_files_are_read_or_refused(kind):
    read, refused = fuzz(kind, 120, 1)
    assert read > 0
    assert refused > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["c3d", "csv", "h5"])
def test_thousands_of_changed_files_are_read_or_refused(kind):
    fuzz(kind, 3000, 2)

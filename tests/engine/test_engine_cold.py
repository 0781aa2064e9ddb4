"""Code that was just compiled and the same code from the cache give bit-for-bit identical results."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite import binding
from numba import config, njit
from small_beam import BEAM

ROOT = Path(__file__).parents[2]
OTHER = BEAM.replace("boundaries:\n", "boundaries:\n  floor: {friction: {face: y_min, coefficient: 0.3}}\n")
"""A scene of another kind, with the same helpers and more."""

DIGEST = """
import hashlib, sys
import cqrun
for scene in sys.stdin.read().split("---"):
    motion = cqrun.load(scene, threads=1).simulate()
print(hashlib.sha256(motion.x.tobytes() + motion.v.tobytes()).hexdigest())
"""


def digest(cache: Path, root: Path = ROOT, scenes: str = BEAM) -> str:
    """Return the digest of the last scene's motion, from another process with a cache and a copy of the package."""
    variables = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    variables |= {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(root)}
    command = [sys.executable, "-c", DIGEST]
    done = subprocess.run(command, input=scenes, env=variables, cwd=root, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the cache's folder is moved by XDG_CACHE_HOME")
def test_first_run_on_a_machine_is_any_later_run_also_of_another_copy(tmp_path):
    """Copies of the package, such as clones and environments, share what one of them has compiled.

    Nor do bits depend on what a process has compiled before.
    """
    cache, copy = tmp_path / "cache", tmp_path / "copy"
    cold = digest(cache)
    compiled = sorted(cache.rglob("*.nbc"))
    assert compiled or config.DISABLE_JIT
    assert digest(cache) == cold
    shutil.copytree(ROOT / "cqrun", copy / "cqrun", ignore=shutil.ignore_patterns("__pycache__"))
    assert digest(cache, copy) == cold
    assert sorted(cache.rglob("*.nbc")) == compiled
    assert config.DISABLE_JIT or digest(tmp_path / "both", scenes=f"{OTHER}---\n{BEAM}") == cold


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_a_kernel_shares_its_helpers_with_no_other():
    import cqrun.numerics.compile  # noqa: F401

    @njit(inline="never")
    def helper(a):
        return a * a + 1.0 if a > 0.0 else helper(-a)

    @njit
    def caller(a):
        return helper(a) - a

    assert caller(2.0) == 3.0
    assert caller(-2.0) == 7.0
    library = caller.overloads[caller.signatures[0]].library
    shared = [f.name for f in library.get_defined_functions() if f.linkage == binding.Linkage.linkonce_odr]
    assert shared == []

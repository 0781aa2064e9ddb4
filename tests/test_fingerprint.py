"""The engine's hash changes with every source that can change a number, and the kernel cache follows it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from plugin_sandbox import sandbox

from cqrun import fingerprint
from cqrun.numerics.compile import share

VERSIONS = {"numba": "1", "numpy": "2", "scipy": "3"}


@pytest.fixture
def package(tmp_path):
    (tmp_path / "engine" / "updated").mkdir(parents=True)
    (tmp_path / "cli").mkdir()
    (tmp_path / "state.py").write_text("a = 1\n")
    (tmp_path / "engine" / "updated" / "step.py").write_text("b = 1\n")
    (tmp_path / "cli" / "app.py").write_text("c = 1\n")
    return tmp_path


def test_the_hash_of_the_engine_has_twelve_hex_digits():
    assert re.fullmatch("[0-9a-f]{12}", fingerprint.engine_hash())
    assert fingerprint.library_versions().keys() == VERSIONS.keys()
    assert "absent" not in fingerprint.library_versions().values()


@pytest.mark.parametrize("file", ["state.py", "engine/updated/step.py"])
def test_a_numeric_source_changes_the_hash(package, file):
    before = fingerprint.source_hash(package, VERSIONS)
    (package / file).write_text("b = 2\n")
    assert fingerprint.source_hash(package, VERSIONS) != before


def test_every_module_with_kernels_is_listed():
    """Numba does not notice a changed helper in another file, so such a file must change the cache's name."""
    package = Path(fingerprint.__file__).parent
    with_kernels = [p for p in package.rglob("*.py") if re.search("numba|cqrun.numerics.compile", p.read_text())]
    rooms = {p.relative_to(package).parts[0] for p in with_kernels} - {
        "fingerprint.py",
        "__init__.py",
        "cli",
        "jobs",
        "running",
        "templates",  # copied to users, and never imported
    }
    assert {"numerics", "engine"} <= rooms <= set(fingerprint.KERNELS)


def test_every_listed_source_exists():
    package = Path(fingerprint.__file__).parent
    assert [entry for entry in fingerprint.NUMERIC if not (package / entry).exists()] == []


AFTERWARDS = {
    "ablation", "api", "autograd", "axes", "bench", "bodies", "compress", "excerpt", "export", "extrapolation",
    "fit_scene", "fleet", "given_values", "grids", "kernels", "lengths", "observables", "oscillation", "own_loss",
    "proposal", "quantities", "reporter", "runs", "seeds", "seen", "selfcheck", "threads", "tracked", "trackers",
    "trajectories", "validate", "warmup",
}  # fmt: skip
"""Modules of jobs and of running that compute before a run, after it, or without one."""


def test_every_job_that_computes_a_run_is_listed():
    """Otherwise a run that another engine started would continue and mix the results of two engines."""
    package = Path(fingerprint.__file__).parent
    uses = re.compile(r"^\s*(import numpy|from cqrun\.(engine\.(rollout|frames)|design\.params))", re.MULTILINE)
    sources = [*(package / "jobs").rglob("*.py"), *(package / "running").rglob("*.py")]
    computing = {p.stem for p in sources if uses.search(p.read_text())}
    listed = {Path(entry).stem for entry in fingerprint.NUMERIC if entry.startswith(("jobs/", "running/"))}
    assert computing - listed <= AFTERWARDS


def test_a_source_of_fitting_changes_the_hash_of_the_engine_but_not_of_its_kernels(package):
    (package / "fitting").mkdir()
    before = [fingerprint.source_hash(package, VERSIONS, e) for e in (fingerprint.NUMERIC, fingerprint.KERNELS)]
    (package / "fitting" / "problem.py").write_text("weights = 2\n")
    after = [fingerprint.source_hash(package, VERSIONS, e) for e in (fingerprint.NUMERIC, fingerprint.KERNELS)]
    assert (before[0] != after[0], before[1] == after[1]) == (True, True)


def test_a_new_and_a_renamed_source_change_the_hash(package):
    before = fingerprint.source_hash(package, VERSIONS)
    (package / "engine" / "updated" / "step.py").rename(package / "engine" / "updated" / "stride.py")
    renamed = fingerprint.source_hash(package, VERSIONS)
    (package / "engine" / "more.py").write_text("")
    assert len({before, renamed, fingerprint.source_hash(package, VERSIONS)}) == 3


def test_the_command_line_does_not_change_the_hash_but_a_library_does(package):
    before = fingerprint.source_hash(package, VERSIONS)
    (package / "cli" / "app.py").write_text("c = 2\n")
    assert fingerprint.source_hash(package, VERSIONS) == before
    assert fingerprint.source_hash(package, VERSIONS | {"numpy": "2.1"}) != before


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("from cqrun.materials.term import register", True),
        ("from cqrun import materials", True),
        ("import cqrun.numerics.tensor as t", True),
        ("def f():\n    from numba import njit", True),
        ("import numba.extending", True),
        ("from cqrun.geometry.shape import Shape\nimport numpy as np", False),
        ("from cqrun.plugin import registry\nfrom . import engine", False),
        ("import cqrun\nx = 'numba'", False),
    ],
)
def test_which_files_outside_the_package_have_kernels(source, expected):
    assert fingerprint.has_kernels(source.encode()) is expected


def test_kernels_that_use_a_plug_in_have_their_own_cache_folder(tmp_path, monkeypatch):
    """One folder for each set of such files, whatever the order in which they were loaded."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with sandbox():
        fingerprint.add_kernels("law_1")
        first = fingerprint.set_kernel_cache()
        assert first.parent == tmp_path / fingerprint.kernel_hash()
        assert Path(share._cache.cache_path).parent == first
        fingerprint.add_kernels("law_2")
        both = fingerprint.set_kernel_cache()
        assert both not in (first, first.parent)
    with sandbox():
        fingerprint.add_kernels("law_2")
        assert fingerprint.set_kernel_cache() not in (first, both)
        fingerprint.add_kernels("law_1")
        assert fingerprint.set_kernel_cache() == both
    own = tmp_path / fingerprint.kernel_hash()
    assert fingerprint.set_kernel_cache() == own
    assert os.environ["NUMBA_CACHE_DIR"] == str(own)  # a child process has its own files


def test_kernels_are_kept_in_the_users_folder_below_their_hash(monkeypatch, tmp_path):
    """Numba does not notice a change of a helper in another file, so another version needs another folder."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert fingerprint.set_kernel_cache() == tmp_path / fingerprint.kernel_hash()
    assert fingerprint.set_kernel_cache() == tmp_path / fingerprint.kernel_hash()  # as in a child process


@pytest.mark.parametrize("first", ["", "import numba; "], ids=["before numba", "after numba"])
def test_numba_uses_the_folder_whenever_it_is_imported(tmp_path, first):
    code = (
        f"{first}import sys, cqrun.fingerprint as f; loaded = 'numba' in sys.modules;"
        "p = f.set_kernel_cache();"
        f"assert ('numba' in sys.modules) == loaded == {bool(first)};"
        "import numba; assert numba.config.CACHE_DIR == str(p), numba.config.CACHE_DIR; print(p)"
    )
    environment = {k: v for k, v in os.environ.items() if k != fingerprint.CACHE_VARIABLE}
    answer = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | {"XDG_CACHE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert answer.stdout.strip() == str(tmp_path / "cqrun" / fingerprint.kernel_hash())

"""Settings for all tests: floating-point errors raise, one seeded generator, no display; scenes of the small beam."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from small_beam import BEAM, FIT

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["CQRUN_PICTURES"] = "0"  # drawing is 40 % of the time of a small run; see the fixture `pictures`

# NaN, overflow and division by zero are failures, also in fixtures of any scope; underflow is not
np.seterr(all="raise", under="ignore")


@pytest.fixture(autouse=True)
def _threads_for_few_particles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use as many threads as a test requests, even for a small robot."""
    for worth in ("THREAD_WORTH", "CALL_WORTH"):
        monkeypatch.setattr(f"cqrun.engine.forward_run.{worth}", 1)


@pytest.fixture(autouse=True)
def _first_phases_are_not_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Print nothing about a command's first phase, which takes more than a moment on a busy machine only."""
    monkeypatch.setattr("cqrun.cli.progress.BRIEF", float("inf"))


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator that is the same for every test and every run."""
    return np.random.default_rng(20190522)


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have runs of commands draw their pictures when they end."""
    monkeypatch.delenv("CQRUN_PICTURES")


@pytest.fixture
def beam(tmp_path: Path) -> Path:
    """Return the small beam's scene, which can be simulated."""
    path = tmp_path / "beam.yaml"
    path.write_text(BEAM)
    return path


@pytest.fixture
def fit(tmp_path: Path) -> Path:
    """Return the small beam's scene with data of its own, which can be fitted."""
    path = tmp_path / "fit.yaml"
    path.write_text(BEAM + FIT)
    return path

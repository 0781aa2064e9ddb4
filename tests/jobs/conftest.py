"""Scenes of the small beam as files."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_beam import BEAM, FIT


@pytest.fixture
def beam(tmp_path: Path) -> Path:
    """Return a scene that can be simulated."""
    path = tmp_path / "beam.yaml"
    path.write_text(BEAM)
    return path


@pytest.fixture
def fit(tmp_path: Path) -> Path:
    """Return a scene that can be fitted."""
    path = tmp_path / "fit.yaml"
    path.write_text(BEAM + FIT)
    return path

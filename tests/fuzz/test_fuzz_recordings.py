"""Whatever is in a recording, cqrun reads it or says what is wrong: no traceback, nothing huge, nothing slow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from harness import faults
from made_recordings import Original, damaged, originals

from cqrun.jobs.validate import validate

SEED = 45

FEW = 60
"""Number of damaged recordings in the short test."""

MANY, CHUNK = 1000, 100
"""Number of damaged recordings in the long test, and in one test of it."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[Original]:
    return originals(tmp_path_factory.mktemp("originals"))


def written(whole: list[Original], folder: Path, seeds: range) -> Iterator[tuple[str, str]]:
    """Write a damaged recording to a folder for every seed, and yield name and text of a scene that uses it."""
    for seed in seeds:
        rng = np.random.default_rng([SEED, seed])
        original = whole[rng.integers(len(whole))]
        file = folder / f"recording-{seed}{original.suffix}"
        file.write_bytes(damaged(original, rng))
        scenes = original.scenes(file.name)
        yield f"{original.suffix[1:]}-{seed}", scenes[rng.integers(len(scenes))]


def test_undamaged_recordings_can_be_used(whole: list[Original], tmp_path: Path) -> None:
    for k, original in enumerate(whole):
        (tmp_path / f"{k}{original.suffix}").write_bytes(original.content)
        for text in original.scenes(f"{k}{original.suffix}"):
            (tmp_path / "a.yaml").write_text(text)
            assert next(iter(validate(tmp_path / "a.yaml"))) == f"{tmp_path / 'a.yaml'}: a valid scene"


def test_some_damaged_recordings_are_read_or_refused(whole: list[Original], tmp_path: Path) -> None:
    assert faults(tmp_path, written(whole, tmp_path, range(FEW))) == []


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, MANY, CHUNK))
def test_damaged_recordings_are_read_or_refused(whole: list[Original], tmp_path: Path, first: int) -> None:
    assert faults(tmp_path, written(whole, tmp_path, range(first, first + CHUNK))) == []

"""Two generations of a state: the newest intact one is loaded."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.store.snapshots import Snapshots


def state(k, rng=None):
    text = json.dumps((rng or np.random.default_rng(k)).bit_generator.state)
    return {"iteration": np.asarray(k), "x": np.full(3, k / 7), "rng": np.asarray(text)}


@pytest.fixture
def stem(tmp_path):
    snapshots = Snapshots(tmp_path / "evals")
    for k in range(5):
        snapshots.save(state(k))
    return tmp_path / "evals"


def test_without_a_saved_state_load_returns_none(tmp_path):
    assert Snapshots(tmp_path / "evals").load() is None


def test_the_newest_state_is_loaded_bit_for_bit(stem):
    loaded = Snapshots(stem).load()
    assert loaded.keys() == state(4).keys()
    assert loaded["x"].tobytes() == state(4)["x"].tobytes()
    assert str(loaded["rng"]) == str(state(4)["rng"])
    assert sorted(p.name for p in stem.parent.iterdir()) == ["evals.0.npz", "evals.1.npz"]


def test_saving_continues_after_the_newest_generation(stem):
    Snapshots(stem).save(state(5))
    assert int(Snapshots(stem).load()["iteration"]) == 5
    Snapshots(stem).paths[0].unlink()
    assert int(Snapshots(stem).load()["iteration"]) == 4


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "other"])
def test_a_damaged_newest_generation_is_skipped_with_a_note(stem, damage):
    newest = stem.with_name("evals.1.npz")  # the fifth generation
    data = bytearray(newest.read_bytes())
    at = data.index(state(4)["x"].tobytes())
    data[at] ^= 1
    spoilt = {"cut": data[: len(data) // 2], "empty": b"", "flipped": data, "other": b"no zip at all"}[damage]
    newest.write_bytes(bytes(spoilt))
    notes = []
    assert int(Snapshots(stem, notes.append).load()["iteration"]) == 3
    assert len(notes) == 1
    assert "evals.1.npz: unreadable" in notes[0]
    after = Snapshots(stem)
    after.save(state(4))  # replaces the damaged file
    assert int(Snapshots(stem).load()["iteration"]) == 4
    assert Snapshots(stem, notes.append).load() is not None
    assert len(notes) == 1


def test_two_damaged_generations_are_an_error(stem):
    for path in Snapshots(stem).paths:
        path.write_bytes(b"x")
    with pytest.raises(UsageError, match=r"unreadable checkpoint.*--fresh"):
        Snapshots(stem).load()

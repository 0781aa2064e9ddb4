"""Controller files: loaded bit-for-bit as saved, and clear errors for any other file."""

from __future__ import annotations

import errno
import zipfile

import numpy as np
import pytest

from cqrun.controllers.controller import ParameterBlock
from cqrun.controllers.mlp import Mlp
from cqrun.controllers.saved import load_controller, save_controller
from cqrun.errors import UsageError


def blocks(rng, hidden=5):
    return Mlp(hidden=[hidden]).blocks(4, 2, 10, -np.ones(2), np.ones(2), np.zeros(2), rng)


@pytest.fixture
def path(tmp_path, rng):
    path = tmp_path / "controller.npz"
    save_controller(path, {b.name: b.initial for b in blocks(rng)}, {"n_controls": 10, "low": [-1.0, 0.5]})
    return path


def test_saved_controller_is_loaded_bit_for_bit(path, rng):
    before = {b.name: b.initial for b in blocks(rng)}
    parameters, meta = load_controller(path, blocks(np.random.default_rng(1)))
    assert parameters.keys() == before.keys()
    assert meta == {"n_controls": 10, "low": [-1.0, 0.5]}
    again = {b.name: b.initial for b in blocks(np.random.default_rng(20190522))}
    assert all(np.array_equal(parameters[name], again[name]) for name in again)
    assert list(path.parent.iterdir()) == [path], "no temporary file is left"


def test_error_for_another_shape_names_both(path, rng):
    words = r"controller of another shape: .*weights0 5 x 4.*this scene's has .*weights0 6 x 4"
    with pytest.raises(UsageError, match=words):
        load_controller(path, blocks(rng, hidden=6))
    with pytest.raises(UsageError, match="this scene's has knots 3 x 2"):
        load_controller(path, [ParameterBlock("knots", np.zeros((3, 2)))])


def test_file_of_another_kind_is_an_error(tmp_path, rng):
    path = tmp_path / "other.npz"
    with pytest.raises(UsageError, match="cannot be read as a controller file: No such file"):
        load_controller(path, blocks(rng))
    for content, words in [(b"", "is not a controller file"), (b"weights: 1\n", "is not a controller file"),
                           (b"PK\x03\x04 cut short", "is not a controller file")]:  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(UsageError, match=words):
            load_controller(path, blocks(rng))
    np.savez(path, weights0=np.zeros(3))
    with pytest.raises(UsageError, match="lacks the entry 'meta'"):
        load_controller(path, blocks(rng))
    np.savez(path, meta=np.array("{"), weights0=np.zeros(3))
    with pytest.raises(UsageError, match="is not JSON"):
        load_controller(path, blocks(rng))
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(UsageError, match=r"is not an \.npz file of arrays"):
        load_controller(tmp_path / "one.npy", blocks(rng))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("notes.txt", "weights")
    with pytest.raises(UsageError, match="contains no named arrays"):
        load_controller(path, blocks(rng))


def test_nothing_in_the_file_is_executed(tmp_path, rng):
    path = tmp_path / "pickled.npz"
    np.savez(path, meta=np.array("{}"), weights0=np.array([{"a": 1}], dtype=object))
    with pytest.raises(UsageError, match="is not a controller file"):
        load_controller(path, blocks(rng))


def test_parameters_that_are_not_finite_are_an_error(path, rng):
    parameters, meta = load_controller(path, blocks(rng))
    parameters["biases1"][0] = np.nan
    save_controller(path, parameters, meta)
    with pytest.raises(UsageError, match="biases1 of the controller are not finite"):
        load_controller(path, blocks(rng))


def test_a_failed_write_leaves_the_old_file(path, rng, monkeypatch):
    old = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_controller(path, {"knots": np.zeros(3)}, {})
    assert path.read_bytes() == old
    assert list(path.parent.iterdir()) == [path]

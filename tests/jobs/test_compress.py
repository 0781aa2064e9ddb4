"""`cqrun compress`: observers learned from runs."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from small_beam import BEAM

from cqrun.errors import MissingExtra, Stopped, UsageError
from cqrun.jobs.compress import compress, raster_of, require_memory
from cqrun.jobs.simulate import run_simulate
from cqrun.observers.pca import load_components
from cqrun.observers.raster import Raster
from cqrun.running.reporter import Silent


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """Return a run of the small beam."""
    folder = tmp_path_factory.mktemp("swing")
    (folder / "beam.yaml").write_text(BEAM)
    return run_simulate(folder / "beam.yaml", (), folder / "out", threads=1)


def test_components_explain_a_swing(swing, tmp_path):
    said = compress([swing, swing], "pca", 2, tmp_path / "pca.npz")
    found = load_components(tmp_path / "pca.npz")
    assert said == f"2 components explain {found.explained.sum():.1%} of the variance"
    assert found.explained.sum() > 0.99
    assert found.modes.shape[0] == 2


def test_a_body_that_is_not_there_is_refused(swing, tmp_path):
    with pytest.raises(UsageError, match=r"no body is called 'bean' \(did you mean 'beam'\?\); there are: beam"):
        compress([swing], "pca", 2, tmp_path / "pca.npz", body="bean")


def test_a_run_without_a_trajectory_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"trajectory.h5: no such trajectory"):
        compress([tmp_path], "pca", 2, tmp_path / "pca.npz")


def test_what_does_not_move_is_refused():
    with pytest.raises(UsageError, match="does not move"):
        raster_of(np.zeros((3, 4, 2)), np.zeros((3, 4, 2)), 8)


@pytest.mark.parametrize(("cells", "size", "option"), [(10**6, 2, "--cells"), (8, 2**62, "--size"), (4, 2, None)])
def test_grids_and_codes_without_bound_are_refused_before_they_are_made(cells, size, option):
    raster = Raster(cells, 0.1, 1.0, 3)
    if option is None:
        require_memory(100, raster, size)
    else:
        with pytest.raises(UsageError, match=rf"needs? .*iB; .* are free: give (fewer|a smaller) {option}"):
            require_memory(100, raster, size)


def test_a_missing_torch_is_named(swing, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtra, match=r"'torch', which is not installed: pip install 'cqrun\[torch\]'"):
        compress([swing], "vae", 2, tmp_path / "vae.npz")


def test_a_file_that_cannot_be_is_told_before_any_work(tmp_path):
    """The runs are not even looked at: they are none."""
    (tmp_path / "encoder.npz").mkdir()
    with pytest.raises(UsageError, match=r"is a directory; --out needs the name of a file"):
        compress([tmp_path], "pca", 2, tmp_path / "encoder.npz")
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"file: cannot be made"):
        compress([tmp_path], "pca", 2, tmp_path / "file" / "encoder.npz")


@pytest.mark.rl
def test_a_training_that_is_stopped_goes_on(swing, tmp_path):
    class Stopping(Silent):
        def advance(self, done, total, text):
            if done == 2:
                self.stop.ask()

    with pytest.raises(Stopped, match="stopped after epoch 2 of 4; the same command continues"):
        compress([swing], "vae", 2, tmp_path / "vae.npz", epochs=4, reporter=Stopping())
    assert not (tmp_path / "vae.npz").exists()
    compress([swing], "vae", 2, tmp_path / "vae.npz", epochs=4)
    compress([swing], "vae", 2, tmp_path / "whole.npz", epochs=4)
    stopped, whole = (dict(np.load(tmp_path / f"{name}.npz")) for name in ("vae", "whole"))
    for name, array in whole.items():
        np.testing.assert_array_equal(stopped[name], array)
    assert not list(tmp_path.glob("*.training"))

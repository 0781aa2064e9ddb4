"""Synthetic data: noise, seeds and copies."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.store.formats.long_table import write_csv
from cqrun.store.recordings import read_recording
from cqrun.store.synthetic import make_synthetic


def test_noise_is_white_seeded_and_different_in_each_copy(rng):
    truth = rng.normal(size=(200, 100, 2))
    time, names = 0.01 * np.arange(200), [f"p{i}" for i in range(100)]
    first, second = make_synthetic(time, names, truth, noise=0.04, copies=2, rng=np.random.default_rng(1))
    errors = first.positions - truth
    assert errors.std() == pytest.approx(0.04, rel=0.02)
    assert (errors**2).sum(axis=2).mean() == pytest.approx(2 * 0.04**2, rel=0.02)
    assert abs(np.mean(errors[1:] * errors[:-1])) < 0.02 * 0.04**2
    assert abs(np.mean(errors * (second.positions - truth))) < 0.02 * 0.04**2
    (again,) = make_synthetic(time, names, truth, noise=0.04, copies=1, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(again.positions, first.positions)


def test_without_noise_the_data_are_the_truth_also_after_a_file(rng, tmp_path):
    truth = rng.normal(size=(5, 2, 3))
    (made,) = make_synthetic(0.1 * np.arange(5), ["a", "b"], truth, noise=0.0, copies=1, rng=rng)
    write_csv(made, tmp_path / "made.csv")
    np.testing.assert_array_equal(read_recording(tmp_path / "made.csv").positions, truth)


def test_wrong_arguments_are_refused(rng):
    with pytest.raises(ValueError, match="must not be negative"):
        make_synthetic(np.arange(3), ["a"], np.zeros((3, 1, 2)), noise=-1, copies=1, rng=rng)
    with pytest.raises(ValueError, match="do not fit"):
        make_synthetic(np.arange(3), ["a"], np.zeros((3, 2, 2)), noise=0, copies=1, rng=rng)

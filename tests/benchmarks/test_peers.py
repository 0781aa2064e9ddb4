"""The substep of cqrun and of the installed peers gives the same loss and gradients."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from benchmarks.peers.__main__ import AGREE, PACKAGES, Worker, compare, line
from benchmarks.peers.problem import SUBSTEPS, block_of
from benchmarks.peers.worker import NAMES, PRECISIONS

SIZE = "2d_6400"


def test_the_block_is_what_cqrun_runs():
    block = block_of(SIZE)
    assert block.x.shape == (6400, 2)
    assert block.gravity == pytest.approx(1.0)
    assert np.ptp(block.E) > 1.0
    low, high = block.x.min(axis=0) / block.dx, block.x.max(axis=0) / block.dx
    assert np.all(low > 2)
    assert np.all(high + 2 < block.nodes)


def test_cqrun_in_its_process():
    """The gradient by all velocities sums to T times the mean of x: the same velocity for all moves x by T."""
    (row,) = compare(SIZE, ["cqrun"], 1, 0)
    block = block_of(SIZE)
    T = SUBSTEPS * block.dt
    centre = block.x.mean(axis=0) + T * block.v.mean(axis=0)
    # for each particle it is about T centre / N
    assert row["by_v"] == pytest.approx(T * np.linalg.norm(centre) / np.sqrt(len(block.x)), rel=0.05)
    assert row["by_E"] > 0
    assert row["ratio"] == 1.0
    assert "1.00 times cqrun" in line(row)


def test_cqrun_in_the_peers_precision_gives_the_same():
    row, _ = compare(SIZE, ["cqrun_float32", "cqrun"], 1, 0)
    assert row["precision"] == "float32"
    assert 0 < row["disagreement"] <= AGREE


def test_a_worker_that_dies_says_so():
    worker = Worker("cqrun", SIZE, 0)
    with pytest.raises(SystemExit, match=r"benchmarks.peers.worker cqrun 2d_6400 0 ended with 1\n(.|\n)*Error"):
        worker.ask("nothing")


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name not in PRECISIONS])
def test_a_peer_agrees(name):
    if importlib.util.find_spec(PACKAGES[name]) is None:
        pytest.skip(f"the extra peers is absent: {name}")
    row, _ = compare(SIZE, [name, "cqrun"], 1, 0)
    assert row["disagreement"] <= AGREE

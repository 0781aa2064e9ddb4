"""What every test gets: floating-point errors raise, one seeded generator, no display."""

from __future__ import annotations

import os

os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def _strict_floats():
    """A stray NaN, overflow or division by zero is a failure; underflow is not."""
    with np.errstate(all="raise", under="ignore"):
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator that is the same for every test and every run."""
    return np.random.default_rng(20190522)

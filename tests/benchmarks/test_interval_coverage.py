"""Do 95 % intervals cover the truth? Fifty fits of the beam twin; `benchmarks/measured` keeps a run of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
LOW, HIGH = 0.90, 0.99


@pytest.mark.slow
def test_fifty_draws_of_the_noise(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import interval_coverage

    share = interval_coverage.summary([interval_coverage.draw(seed, []) for seed in range(50)])["all"]
    assert LOW <= share <= HIGH


def test_what_is_kept_was_counted_right():
    kept = json.loads((BENCHMARKS / "measured" / "beam_twin_coverage.json").read_text())
    hits = [
        low <= truth <= high
        for entry in kept["draws"]
        for truth, _, (low, high) in entry["unknowns"].values()
    ]  # fmt: skip
    assert kept["covered"]["all"] == pytest.approx(np.mean(hits))
    assert LOW <= np.mean(hits) <= HIGH
    assert {entry["seed"] for entry in kept["draws"]} == set(range(50))

"""The distance of a centroid from a goal, and its adjoint."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.engine.model import Records
from cqrun.fitting.points import centroid
from cqrun.fitting.target import TargetObjective


def record_of(rng, dim):
    x, v = rng.normal(size=(2, 6, 1, dim))
    return Records(x, v, np.zeros((6, 1, dim, dim)), np.tile(np.eye(dim), (6, 1, 1, 1)))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("time", [0.0, 0.37, 0.5])
def test_value_and_adjoint(rng, dim, time):
    goal = rng.normal(size=dim)
    objective = TargetObjective(centroid(np.ones(4)), goal, time=time, control_step=0.1, steps=5)
    record, direction = record_of(rng, dim), record_of(rng, dim)
    if time != 0.37:
        expected = np.sum((record.x[round(10 * time), 0] - goal) ** 2)
        assert objective.loss(record) == pytest.approx(expected)
    moved = lambda h: objective.loss(Records(*(a + h * d for a, d in zip(record, direction, strict=True))))  # noqa: E731
    expected = (moved(0.5) - moved(-0.5)) / 1.0  # exact: the loss is quadratic
    found = sum(np.sum(a * d) for a, d in zip(objective.loss_vjp(record), direction, strict=True))
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("time", "words"), [(-0.1, "must not be negative"), (0.6, "after the rollout's end")])
def test_times_outside_the_rollout(time, words):
    with pytest.raises(ValueError, match=words):
        TargetObjective(centroid(np.ones(4)), np.zeros(2), time=time, control_step=0.1, steps=5)

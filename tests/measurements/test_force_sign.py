"""A force whose sign is still wrong with the values of the result is told."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cqrun.measurements.force import ReactionComparison


@pytest.mark.parametrize(("model", "told"), [(-3.0, True), (3.0, False), (-0.001, False)])
def test_the_sign_at_the_last_telling_point(model: float, told: bool) -> None:
    values = np.array([0.0, 5.0, model, 5.0])[:, None, None]  # the rest shape, then the points
    fit = SimpleNamespace(
        telling=(1,), data=np.array([1.0, 4.0, 1.0])[:, None, None], observe=lambda records: records,
        column="F_N", spec=SimpleNamespace(shown=SimpleNamespace(name="N")),
    )  # fmt: skip
    found = ReactionComparison.wrong_at_the_end(fit, values)
    assert bool(found) == told
    if told:
        assert found[0].startswith(
            "'F_N' has the wrong sign with the values found, too: it is 4 N, and the model has -3"
        )

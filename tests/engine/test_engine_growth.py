"""Where a gradient is said to grow: where it does on its way back, and not where the loss adds to it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import world

from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.policy import Sight, SightBar
from cqrun.state import State

T, STEEP = 7, 3


class Steep:
    """A policy that does nothing, and whose adjoint at one control step is large: what it saw, or a whole state."""

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def act(self, control: int, sight: Sight, memory: np.ndarray, state: Any) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(5), memory

    def act_vjp(
        self, control: int, sight: Sight, memory: np.ndarray, state: Any, activation_bar: np.ndarray,
        memory_bar: np.ndarray, parameters_bar: Any,
    ) -> tuple[SightBar, np.ndarray, State | None]:  # fmt: skip
        record_bar, seen = np.zeros(sight.rows.shape), state()
        if control == STEEP and self.kind == "record":
            record_bar[0] = 20.0
        whole = State(np.ones(seen.x.shape), *(np.zeros_like(a) for a in (seen.v, seen.C, seen.F, memory)))
        return SightBar(record_bar), memory_bar, whole if control == STEEP and self.kind == "state" else None

    def parameters_zero(self) -> None:
        return None


@pytest.mark.parametrize("kind", ["record", "state"])
@pytest.mark.parametrize("over", ["final", "mean"])
def test_growth_is_where_the_gradient_grows_and_not_where_the_loss_adds_to_it(over, kind, rng):
    """A loss at all control steps adds the more, of what there is, the nearer they are to the end."""
    x = 0.3 + 0.4 * rng.random((12, 2))
    model, inputs = world(
        x, size=[1.0, 1.0], dx=0.1, dt=1e-3, substeps=2, controls=T, volume=1e-3, probe=np.full((1, 12), 1 / 12)
    )
    rollout = make_rollout(model, inputs, adjoint=True, policy=Steep(kind))
    bar = Records.zeros(T, 1, 2)
    bar.x[T if over == "final" else slice(1, None)] = 1.0
    rollout.gradient(lambda records, state: LossBar(bar))
    assert rollout.growth_at == STEEP

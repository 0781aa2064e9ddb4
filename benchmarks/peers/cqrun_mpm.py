"""The substep in cqrun itself, on one thread."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.peers.problem import SUBSTEPS, model_of
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar
from cqrun.state import State


class Cqrun:
    """The block of a size in one precision."""

    def __init__(self, size: str, precision: str) -> None:
        self.rollout = make_rollout(*model_of(size, np.dtype(precision)), threads=1, adjoint=True)
        self.states = np.empty((SUBSTEPS + 1, *self.rollout.start.shape), self.rollout.start.dtype)
        self.forward()

    def forward(self) -> None:
        """Run all substeps and keep their states."""
        self.states[0] = self.rollout.start
        self.rollout.advance(0, SUBSTEPS, self.states, keep=True)
        self.last = self.rollout.unpack(self.states[SUBSTEPS], 1)

    def backward(self) -> None:
        """Run the adjoint of all substeps from the kept states."""
        x = self.last.x
        bar = State(x / len(x), np.zeros_like(x), np.zeros_like(self.last.C), np.zeros_like(self.last.F))
        self.pass_back = self.rollout.backward(LossBar(final=bar))
        self.pass_back.run(0, SUBSTEPS, self.states)

    def results(self) -> Mapping[str, float]:
        """Return the loss and the norms of both gradients."""
        bar = self.pass_back.inputs_bar()
        by_v, by_E = bar.state.v, bar.terms[0][0][0]
        loss = 0.5 * float((self.last.x**2).sum(axis=1).mean())
        return {"loss": loss, "by_v": float(np.linalg.norm(by_v)), "by_E": float(np.linalg.norm(by_E))}


def make(size: str, precision: str) -> Cqrun:
    """Return the implementation of a size in a precision."""
    return Cqrun(size, precision)


BACKWARD_HOLDS_FORWARD = False
"""Whether `backward` also runs the substeps forward. If so, the time of `forward` is not added."""

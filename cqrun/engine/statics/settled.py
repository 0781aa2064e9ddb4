"""A motion that starts at rest under its first loads and activations, so that nothing has to settle.

The first state is the equilibrium u*(theta) of the loads and activations of the first control step, with v = 0. The
gradient of the motion gives u*_bar, and the adjoint of the equilibrium carries it on to everything that u* depends on.

Histories are those of a long rest at u* (`history.settle`), whose adjoint adds to u*_bar.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.model import Inputs, LossBar
from cqrun.engine.reference.backward import ReferenceBackward
from cqrun.engine.reference.history import Histories, rows_of_state, rows_of_table, settle, settle_vjp
from cqrun.engine.reference.rollout import ReferenceRollout
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.errors import RunError
from cqrun.numerics.packed import pack
from cqrun.plugin.contract import Array
from cqrun.state import ParticleFields, State

TOLERANCE = 1e-10
"""Residual of the first state: far below what a motion adds in its first substep."""


class SettledRollout(ReferenceRollout):
    """A rollout in the reference frame that starts at equilibrium; see `ReferenceRollout`."""

    def _make_start(self) -> Array:
        model, inputs = self.model, self.inputs
        first = replace(inputs, activation=inputs.activation[:1], moves=inputs.moves * 0.0)
        self.first = Equilibrium(replace(model, n_controls=1, substeps=1), first, threads=self.threads)
        if loose := self.first.loose_bodies():
            names = ", ".join(loose)
            raise RunError(f"`start: equilibrium`: nothing holds {names}, so there is no rest to start from")
        rest = self.first.solve(tolerance=TOLERANCE)
        if not rest.converged:
            raise RunError(
                f"`start: equilibrium`: no equilibrium was found under the first loads (residual {rest.residual:.1e}); "
                "`cqrun rest` shows how far a path of loads gets"
            )
        start = self._still_state()
        start[0, : self.rest.patches.n_nodes] = rest.u
        for each in self.histories:
            self._settle(each, start)
        self.free_start = np.zeros((self.rest.patches.n_nodes, model.dim))
        return start

    def _settle(self, histories: Histories, start: Array) -> None:
        """Write the histories of a long rest to the start."""
        settle(histories, self.bundle, start[0], self.rest.patches.colours)
        start[:, histories.begin :] = rows_of_state(self.bundle.q, histories.first)

    def backward(self, loss_bar: LossBar) -> BackwardRun:
        """Return the backward run, from kept states, of the cotangents of the results."""
        return SettledBackward(self, loss_bar, reverses=False)

    def _reversed_backward(self, loss_bar: LossBar) -> BackwardRun:
        return SettledBackward(self, loss_bar, reverses=True)


class SettledBackward(ReferenceBackward):
    """The backward run of a motion that starts at equilibrium."""

    def inputs_bar(self) -> Inputs:
        """Return the cotangent of the inputs."""
        for each in self.histories:
            self._settle_vjp(each)
        bar, first = super().inputs_bar(), self.rollout.first
        nodes = slice(self.rollout.rest.patches.n_nodes)
        static, solve = first.gradient_of_nodes(self.rollout.start[0, nodes], self.q_bar[0, nodes])
        if not solve.converged:
            raise RunError("the adjoint of the equilibrium that the motion starts from was not found: see `cqrun rest`")
        static.activation = np.concatenate(
            [static.activation, np.zeros((len(bar.activation) - 1, bar.activation.shape[1]))]
        )
        static.moves = static.moves * 0.0
        return added(bar, static)

    def _settle_vjp(self, histories: Histories) -> None:
        """Carry the cotangent of the histories at the start on to that of the displacements."""
        r, run, bars, begin = self.rollout, self.rollout.bundle, self.bundle, histories.begin
        rows = rows_of_table(self.q_bar[:, begin:], run.q.shape[1] - histories.first)
        bars.q[:, histories.first :] = pack(rows, bars.q.dtype)
        settle_vjp(histories, run, bars, r.start[0], r.rest.patches.colours)
        self.q_bar[:, begin:] = 0.0
        bars.q[:, histories.first :] = 0.0

    def _state_bar(self) -> State:
        """Return the cotangent of the state at the start, which has no motion of its own."""
        self.q_bar[1] = 0.0
        return super()._state_bar()


def added(a: Inputs, b: Inputs) -> Inputs:
    """Return the sum of two cotangents of inputs, in the first one's arrays."""
    for field in fields(Inputs):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, State):
            _add(x.x, y.x)
        elif isinstance(x, ParticleFields):
            for part in fields(ParticleFields):
                _add(getattr(x, part.name), getattr(y, part.name))
        elif isinstance(x, list):
            for group, group_b in zip(x, y, strict=True):
                for theta, theta_b in zip(group, group_b, strict=True):
                    _add(theta, theta_b)
        elif isinstance(x, np.ndarray):
            _add(x, y)
    return a


def _add(a: Any, b: Any) -> None:
    a += b

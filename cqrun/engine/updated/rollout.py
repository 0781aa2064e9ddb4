"""Rollouts in the updated frame: the state is that of the particles (x, v, C, F), and the grid has no memory."""

from __future__ import annotations

import numpy as np

from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.model import LossBar
from cqrun.engine.probe import record
from cqrun.engine.rollout import Rollout
from cqrun.engine.setting import MARGIN, Crew
from cqrun.engine.suspects import suspect
from cqrun.engine.updated.backward import UpdatedBackward
from cqrun.engine.updated.setting import Run, Setting, make_work, node_strides
from cqrun.engine.updated.step import advance
from cqrun.numerics.packed import unpack
from cqrun.plugin.contract import Array
from cqrun.state import State

CHAINED_FROM = 3 << 20
"""Bytes of a state from which substeps are chained tile by tile: from about here a substep exceeds the last cache."""


class UpdatedRollout(Rollout):
    """Run one model in the updated frame; see `Rollout`."""

    def _pack(self) -> None:
        model, inputs = self.model, self.inputs
        layout, real, shape = model.layout, model.real, model.grid_shape
        self.start = inputs.state.pack(layout, real)
        self.fields = self._pack_fields(inputs.fields)
        self.drive = model.kernel_drive(inputs)
        self.groups = self.kernel_groups(inputs.terms, self.drive)
        self.conditions = tuple(c.kernel(inputs.coefficients[k]) for k, c in enumerate(model.conditions))
        self.probe = model.kernel_probe()
        self.setting = Setting(
            (0,) * model.dim, node_strides(shape), tuple(float(n - 2) for n in shape), model.dx, model.dt,
            model.substeps, self.start.nbytes >= CHAINED_FROM and model.substeps > 1,
        )  # fmt: skip
        bits = model.condition_bits()
        self.work = make_work(shape, layout.n, bits, len(model.conditions), real, adjoint=self.adjoint, team=self.team)
        push = model.no_push([*self.drive.steady, *self.drive.forces])
        self.bundle = Run(self.setting, self.work, self.fields, push)
        self._check_start()

    def _record_start(self) -> None:
        record(self.probe, self.start, self.records[0])

    def backward(self, loss_bar: LossBar) -> BackwardRun:
        """Return the backward run from the cotangents of the results."""
        return UpdatedBackward(self, loss_bar)

    def unpack(self, q: Array, control: int) -> State:
        """Return a packed state of a control step as a State."""
        return State.unpack(q, self.model.layout, self.memory[control])

    def _check_start(self) -> None:
        astray = self._astray(self.start)
        if astray.any():
            self._fail(int(np.flatnonzero(astray)[0]), 0, self.start)
        self._check_masses()

    def _astray(self, q: Array) -> Array:
        """Return for each kernel column whether its particle is off the grid or not finite (n,)."""
        x = unpack(q)[: self.model.dim] / self.model.dx + MARGIN
        return ~np.all((x > 1.0) & (x < np.array(self.setting.upper)[:, None]), axis=0)

    def _advance(self, begin: int, end: int, states: Array, keep: bool) -> None:
        stray = self.work.stray
        stray[:] = -1

        def body(thread: int, to: int = end, n: int = self.threads) -> int:
            reached: int = advance(
                self.groups, self.conditions, self.drive, self.bundle, states, begin, to, keep, self.probe,
                self.records, Crew(thread, n),
            )  # fmt: skip
            return reached

        if self.threads > 1:
            body(0, begin, 1)  # compile on one thread, so that the others do not wait for it at a barrier
        reached = self.team.run(body)
        if stray.max() >= 0:
            q = states[reached - begin if keep else 0]
            # a kernel writes the first column of the lane with the stray particle
            lane = int(stray[stray >= 0].min())
            astray = np.flatnonzero(self._astray(q)[lane:])
            self._fail(lane + int(astray[0]) if len(astray) else lane, reached, q)

    def _fail(self, column: int, step: int, q: Array) -> None:
        """Raise a RolloutError about a particle that is lost, with the likely cause."""
        x, particle = unpack(q)[: self.model.dim, column], int(self.model.layout.sources()[column])
        cause = "" if step == 0 else suspect(self.model, self.unpack(q, 0), self.activation_at(step))
        if np.isfinite(x).all():
            reason = f"left the grid at {np.array2string(x.astype(float), precision=4)} m{self._speed(column, q)}"
            advice = "enlarge the world, add a boundary at its faces, or reduce what drives the body out"
            advice = f"{cause}; or else {advice}" if cause else advice
        else:
            reason = "its position is not finite"
            advice = f"the simulation blew up: {cause or 'use smaller substeps, a softer material or weaker actuation'}"
            advice = self._with_limit(advice, particle)
        self._report(particle, step, reason, advice)

    def _speed(self, column: int, q: Array) -> str:
        """Return the speed of a particle as text, if it moves by more than half a cell in a substep."""
        speed = float(np.linalg.norm(unpack(q)[self.model.dim : 2 * self.model.dim, column].astype(float)))
        cells = speed * self.model.dt / self.model.dx
        return f", at {speed:.4g} m/s, which is {cells:.4g} cells in a substep" if cells > 0.5 else ""

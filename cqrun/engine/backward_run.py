"""The backward run of a rollout in any frame: cotangents in the kernels' layout, and those of the policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from cqrun.engine.forward_run import ForwardRun
from cqrun.engine.model import Inputs, LossBar
from cqrun.engine.policy import SightBar
from cqrun.engine.setting import Drive
from cqrun.forces.force import Levels
from cqrun.numerics.packed import aligned, unpack
from cqrun.plugin.contract import Array
from cqrun.state import DECAY, FORCE, MASS, VOLUME, State


class BackwardRun(ABC):
    """Run a rollout backward from the cotangents of its results. A subclass for each frame has the kernels.

    Attributes:
        here: the packed state whose cotangent the run has.
        parameters_bar: the cotangents of the policy's parameters in the policy's own form; None without a policy.
    """

    def __init__(self, rollout: ForwardRun, loss_bar: LossBar) -> None:
        self.rollout, self.here = rollout, rollout.final
        self.q_bar = aligned(rollout.start.shape, rollout.start.dtype)
        self.fields_bar = aligned(rollout.fields.shape, rollout.fields.dtype)
        self.drive_bar = self._drive_bar()
        zeros = [[np.zeros_like(theta) for theta in group] for group in rollout.inputs.terms]
        self.groups_bar = rollout.kernel_groups(zeros, self.drive_bar)
        self.coefficient_bar = np.zeros(rollout.model.n_coefficients)
        self.pairs = tuple(zip(rollout.groups, self.groups_bar, strict=True))
        self.stresses = tuple(zip(rollout.drive.stresses, self.drive_bar.stresses, strict=True))
        self.size_before: dict[int, float] = {}
        self.size_after: dict[int, float] = {}
        self.total = aligned(self.q_bar.shape, self.q_bar.dtype)
        self.parameters_bar: Any = None if rollout.policy is None else rollout.policy.parameters_zero()
        self._make_bars()
        self._begin(loss_bar)

    def _drive_bar(self) -> Drive:
        """Return the drive with zero cotangents."""
        drive = self.rollout.drive
        stresses = (s._replace(theta=np.zeros_like(s.theta), weight=np.zeros_like(s.weight)) for s in drive.stresses)
        return drive._replace(levels=Levels(*map(np.zeros_like, drive.levels)), stresses=tuple(stresses))

    def _begin(self, loss_bar: LossBar) -> None:
        rollout = self.rollout
        self.memory_bar = np.zeros_like(rollout.inputs.state.memory)
        if loss_bar.final is not None:
            self._add_state(loss_bar.final)
            self.memory_bar += loss_bar.final.memory
        self.records_bar = np.zeros_like(rollout.records)
        if loss_bar.records is not None:
            self.records_bar += loss_bar.records.to_rows(rollout.model.layout.table)
        if loss_bar.activation is not None:
            self.drive_bar.levels.activation[:, : len(rollout.model.actuators)] = loss_bar.activation
        if rollout.policy is not None:
            self.size_after[rollout.model.n_controls] = self._size(self.records_bar[-1])

    @abstractmethod
    def _make_bars(self) -> None:
        """Make the arguments of the kernels that are cotangents."""

    @abstractmethod
    def _add_state(self, bar: State) -> None:
        """Add the cotangent of the current state."""

    @abstractmethod
    def _add_record(self, q_bar: Array, record_bar: Array) -> None:
        """Add the cotangent of a record of the current state to `q_bar`."""

    @abstractmethod
    def _reverse(self, begin: int, end: int, states: Array) -> None:
        """Run the adjoints of substeps end - 1 .. begin of a piece in which the policy decides nothing."""

    @abstractmethod
    def _state_bar(self) -> State:
        """Return the cotangent of the state at the start, after all substeps; `fields_bar` is complete then."""

    def run(self, begin: int, end: int, states: Array) -> None:
        """Run the adjoints of substeps end - 1 .. begin, whose states are kept in `states`."""
        r, at, substeps = self.rollout, end, self.rollout.model.substeps
        while at > begin:
            start = begin if r.policy is None else max(begin, (at - 1) // substeps * substeps)
            kept = self._from(states, start - begin)
            self._reverse(start, at, kept)
            self.here = kept[0]
            if r.policy is not None and start % substeps == 0:
                self._policy_vjp(start // substeps, self.here)
            at = start
        if begin == 0:
            self._add_record(self.q_bar, self.records_bar[0])

    def _from(self, states: Array, k: int) -> Array:
        """Return the kept states from the k-th on."""
        return states[k:]

    @property
    def growth(self) -> tuple[float, int]:
        """The largest growth factor of |q_bar| over a control step, and the number of this step.

        The cotangents that the loss adds do not count as growth. (0, -1) without a policy, or if the loss does not
        depend on the motion.
        """
        after = self.size_after
        grown = [(size / after[k + 1], k) for k, size in self.size_before.items() if after.get(k + 1, 0.0) > 0]
        return max(grown, key=lambda each: each[0], default=(0.0, -1))

    def _policy_vjp(self, control: int, q: Array) -> None:
        """Carry the cotangent of a control step's activations back through the policy."""
        r = self.rollout
        assert r.policy is not None
        bar, self.memory_bar, state_bar = r.policy.act_vjp(
            control, r.sight(control), r.memory[control], lambda: r.unpack(q, control),
            self.drive_bar.levels.activation[control, : len(r.model.actuators)], self.memory_bar, self.parameters_bar,
        )  # fmt: skip
        if state_bar is not None:
            self._add_state(state_bar)
        self.size_before[control] = self._size(bar.rows)
        self._add_sight(control, bar)
        self.size_after[control] = self._size(self.records_bar[control])

    def _add_sight(self, control: int, bar: SightBar) -> None:
        """Add the cotangent of what the policy saw at the start of a control step, all of which is older than it."""
        self.records_bar[control] += bar.rows
        levels = self.drive_bar.levels
        if control > 0 and bar.activation is not None:
            levels.activation[control - 1, : len(bar.activation)] += bar.activation
        given = (levels.strength, bar.strength), (levels.rest, bar.rest_length), (levels.friction, bar.friction)
        for total, more in given:
            if more is not None:
                total += more

    def _size(self, record_bar: Array) -> float:
        """Return |q_bar| after the cotangent of a record is added; the next substep backward adds it."""
        if not record_bar.any():
            return float(np.linalg.norm(self.q_bar))
        self.total[...] = self.q_bar
        self._add_record(self.total, record_bar)
        return float(np.linalg.norm(self.total))

    def inputs_bar(self) -> Inputs:
        """Return the cotangent of the inputs."""
        r, layout, levels = self.rollout, self.rollout.model.layout, self.drive_bar.levels
        bar, columns = Inputs.zeros_like(r.inputs), layout.columns()
        bar.state = self._state_bar()
        f = unpack(self.fields_bar)[:, columns]
        bar.fields.mass[:], bar.fields.volume[:] = f[MASS], f[VOLUME]
        bar.fields.damping[:] = -r.model.dt * np.exp(-r.inputs.fields.damping * r.model.dt) * f[DECAY]
        bar.fields.force[:] = f[FORCE:].T
        for g, (group, slice_) in enumerate(zip(self.groups_bar, r.model.group_slices(), strict=True)):
            for k in range(len(bar.terms[g])):
                theta_bar = unpack(group.terms[k].theta)
                bar.terms[g][k][:] = theta_bar[: len(bar.terms[g][k]), columns[slice_]]
        bar.activation[:] = levels.activation[:, : len(r.model.actuators)]
        bar.strength[:], bar.coefficients[:] = levels.strength, self.coefficient_bar
        if len(bar.rest):
            bar.rest[:] = levels.rest
        if len(bar.friction):
            bar.friction[:] = levels.friction
        for kind in self.drive_bar.stresses if len(bar.weights) else ():
            for k, a in enumerate(kind.actuators):
                bar.weights[r.model.weight_slices[a]] = kind.weight[kind.start[k] : kind.start[k + 1]]
        return bar

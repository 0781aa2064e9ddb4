"""Some substeps of a rollout, run again and again: how long they take as a whole, and pass by pass."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.blocks import SORT_EVERY, sort_particles
from cqrun.engine.drive import activate, activate_vjp, push_particles, push_particles_vjp
from cqrun.engine.grid import clear, update_grid, update_grid_vjp
from cqrun.engine.model import LossBar
from cqrun.engine.probe import record, record_vjp
from cqrun.engine.rollout import Rollout
from cqrun.engine.step import (
    momentum_of_each,
    momentum_of_each_vjp,
    move_each,
    move_each_vjp,
    scatter_blocks,
)
from cqrun.plugin.contract import Array
from cqrun.state import State


class Pass(NamedTuple):
    """One pass of a substep: `body(thread)` runs it, as often a substep as `calls` says."""

    name: str
    body: Callable[[int], Any]
    calls: float = 1.0


class Excerpt:
    """Substeps `begin` .. `begin + length` of a rollout whose adjoint may be run.

    Args:
        rollout: with `adjoint=True`; its own start is where the excerpt begins unless `q` says otherwise.
        begin: a control step's first substep.
        length: substeps, whole control steps.
        q: the packed state at `begin`.
    """

    def __init__(self, rollout: Rollout, begin: int, length: int, q: Array | None = None) -> None:
        self.rollout, self.begin, self.end = rollout, begin, begin + length
        self.control, self.substeps = begin // rollout.model.substeps, rollout.model.substeps
        self.n = rollout.model.layout.n_particles
        self.q = rollout.start if q is None else q
        self.states = np.empty((length + 1, *self.q.shape), self.q.dtype)
        self.here = np.empty((1, *self.q.shape), self.q.dtype)
        last = State.at_rest(rollout.inputs.state.x)
        last.memory = np.zeros_like(rollout.inputs.state.memory)
        self.backward = BackwardRun(rollout, LossBar(final=last))

    def forward(self) -> None:
        """Run all substeps, as a rollout without gradient does."""
        self.rollout.advance(self.begin, self.end, self.here, keep=False)

    def store(self) -> None:
        """Run all substeps and keep their states."""
        self.rollout.advance(self.begin, self.end, self.states, keep=True)

    def reverse(self) -> None:
        """Run the adjoint of all substeps from the kept states."""
        self.backward.run(self.begin, self.end, self.states)

    def rewind(self) -> None:
        """Put the start where both runs begin, and have the policy decide again; no part of a substep, so not timed."""
        self.here[0] = self.states[0] = self.q
        if self.rollout.policy is not None:
            self.rollout.decided = self.control

    def measure(self, repeat: int) -> dict[str, Any]:
        """Return ns a particle and substep of the whole and of each pass: medians, the first run left out."""
        whole: dict[str, list[float]] = {"forward": [], "store": [], "backward": []}
        for _ in range(repeat + 1):
            for name, run in (("forward", self.forward), ("store", self.store), ("backward", self.reverse)):
                if name != "backward":
                    self.rewind()
                whole[name].append(timed(run))
        substeps = self.end - self.begin
        result: dict[str, Any] = {name: self.nanoseconds(seconds[1:], substeps) for name, seconds in whole.items()}
        result["backward_over_forward"] = float(
            np.median(np.array(whole["backward"][1:]) / np.array(whole["forward"][1:]))
        )
        result["passes"] = {}
        for each in (*self.forward_passes(), *self.backward_passes()):
            seconds = [timed(lambda: self.rollout.team.run(each.body)) for _ in range(repeat + 1)]  # noqa: B023
            self.backward.q_bar[...] = 0.0
            result["passes"][each.name] = self.nanoseconds(seconds[1:], 1) * each.calls
        return result

    def nanoseconds(self, seconds: list[float], substeps: int) -> float:
        """Return the median, a particle and substep [ns]."""
        return float(np.median(seconds)) / (self.n * substeps) * 1e9

    # --- pass by pass, in an order in which each finds what it needs ------------------------------------------------

    def forward_passes(self) -> Iterator[Pass]:
        """Yield the passes of a substep, as `engine/step.py` lists them."""
        self.rewind()
        self.store()
        r, n, control = self.rollout, self.rollout.threads, self.control
        setting, work, drive, fields = r.setting, r.work, r.drive, r.fields
        q, q_next = self.states[0], self.states[1]
        once = 1.0 / self.substeps
        apart = once if setting.chained else 1.0
        if r.policy is not None:
            yield Pass("policy", alone(self._policy), once)
        if drive.stresses:
            yield Pass("activate", alone(lambda: activate(drive, control)), once)
        if len(drive.push):
            yield Pass("push", alone(lambda: push_particles(drive, control, q, fields)))
        yield Pass("momentum", lambda t: momentum_of_each(r.groups, q, fields, drive.push, setting, work, t, n), apart)
        yield Pass("sort", alone(lambda: sort_particles(work.blocks, work.place)), 1.0 / SORT_EVERY)
        yield Pass("clear", lambda t: clear(work.grid, 1, setting, work, t, n))
        value, affine = (work.value,), (work.affine,)
        yield Pass("scatter", lambda t: scatter_blocks(work.grid, value, affine, setting, work, t, n))
        yield Pass("update_grid", lambda t: update_grid(setting, r.conditions, work, t, n))

        def move(thread: int, ahead: bool = False) -> None:
            move_each(r.groups, q, q_next, fields, drive.push, ahead, setting, work, thread, n)

        yield Pass("move", move, apart)
        if setting.chained:
            yield Pass("move_momentum", lambda t: move(t, True), 1.0 - apart)
        if r.probe.start.shape[0] > 1:
            rows = np.ones_like(r.records[0])
            yield Pass("record", alone(lambda: record(r.probe, q, rows)), once)

    def backward_passes(self) -> Iterator[Pass]:
        """Yield the passes of a substep's adjoint, but for those that it does again of the substep."""
        r, b, n, control = self.rollout, self.backward, self.rollout.threads, self.control
        setting, work, drive, bar, fields = r.setting, r.work, r.drive, b.drive_bar, r.fields
        q, q_next = self.states[0], self.states[1]
        once, rows = 1.0 / self.substeps, np.ones_like(r.records[0])
        apart = once if setting.chained else 1.0
        if r.probe.start.shape[0] > 1:
            yield Pass("record_vjp", alone(lambda: record_vjp(r.probe, b.q_bar, rows)), once)
        yield Pass("move_vjp", lambda t: move_each_vjp(r.groups, q, q_next, b.q_bar, setting, work, t, n), apart)
        values, affines = (work.value, work.value_2), (work.affine, work.affine_2)
        yield Pass("clear_both", lambda t: clear(work.both, 2, setting, work, t, n))
        yield Pass("scatter_both", lambda t: scatter_blocks(work.both, values, affines, setting, work, t, n))
        yield Pass("update_grid_vjp", lambda t: update_grid_vjp(setting, r.conditions, work, t, n))
        pairs = tuple(zip(r.groups, b.groups_bar, strict=True))

        def momentum_vjp(thread: int, ahead: bool = False) -> None:
            momentum_of_each_vjp(
                pairs, q_next, b.q_bar, fields, b.fields_bar, bar.push, ahead, q, drive.push, setting, work, thread, n
            )

        yield Pass("momentum_vjp", momentum_vjp, apart)
        if setting.chained:
            yield Pass("momentum_move_vjp", lambda t: momentum_vjp(t, True), 1.0 - apart)
        if len(drive.push):
            yield Pass(
                "push_vjp",
                alone(lambda: push_particles_vjp(drive, bar, control, q, b.q_bar, fields, b.fields_bar)),
            )
        if drive.stresses:
            stresses = tuple(zip(drive.stresses, bar.stresses, strict=True))
            yield Pass("activate_vjp", alone(lambda: activate_vjp(drive, bar, stresses, control)), once)
        if r.policy is not None:
            yield Pass("policy_vjp", alone(self._policy_vjp), once)

    def _policy(self) -> None:
        r, control = self.rollout, self.control
        assert r.policy is not None
        r.policy.act(control, r.records[control], r.memory[control], lambda: r.unpack(self.q, control))

    def _policy_vjp(self) -> None:
        r, control = self.rollout, self.control
        assert r.policy is not None
        memory = r.memory[control]
        r.policy.act_vjp(
            control, r.records[control], memory, lambda: r.unpack(self.q, control), np.ones_like(r.activation[control]),
            np.zeros_like(memory), r.policy.parameters_zero(),
        )  # fmt: skip


def alone(run: Callable[[], Any]) -> Callable[[int], Any]:
    """Return a pass that one thread runs while the others wait."""
    return lambda thread: run() if thread == 0 else None


def timed(run: Callable[[], Any]) -> float:
    """Return how long a call takes [s]."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin

"""Measure the time of some substeps of a rollout, in total and for each pass."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.blocks import SORT_EVERY
from cqrun.engine.drive import activate, activate_vjp
from cqrun.engine.model import LossBar
from cqrun.engine.probe import record, record_vjp
from cqrun.engine.rollout import Rollout
from cqrun.engine.setting import Crew
from cqrun.engine.updated.rollout import UpdatedRollout
from cqrun.engine.updated.setting import Substep
from cqrun.engine.updated.step import BACKWARD, FORWARD, MEET
from cqrun.numerics.compile import Pass
from cqrun.plugin.contract import Array
from cqrun.state import State


class TimedPass(NamedTuple):
    """One pass: `body(thread)` runs it, `calls` is how often it runs per substep."""

    name: str
    body: Callable[[int], Any]
    calls: float = 1.0


class Excerpt:
    """Substeps `begin` .. `begin + length` of a rollout, and their adjoint.

    Args:
        rollout: a rollout with `adjoint=True`.
        begin: the first substep of a control step.
        length: number of substeps, whole control steps.
        q: the packed state at `begin`; the start of the rollout if not given.
    """

    def __init__(self, rollout: Rollout, begin: int, length: int, q: Array | None = None) -> None:
        self.rollout: Any = rollout
        self.begin, self.end = begin, begin + length
        self.control, self.substeps = begin // rollout.model.substeps, rollout.model.substeps
        self.n = rollout.model.layout.n_particles
        self.q = rollout.start if q is None else q
        self.states = np.empty((length + 1, *self.q.shape), self.q.dtype)
        self.here = np.empty((1, *self.q.shape), self.q.dtype)
        x, memory = rollout.inputs.state.x, np.zeros_like(rollout.inputs.state.memory)
        last = replace(State.at_rest(x), memory=memory)
        self.backward: Any = rollout.backward(LossBar(final=last))

    def forward(self) -> None:
        """Run all substeps like a rollout without gradient."""
        self.rollout.advance(self.begin, self.end, self.here, keep=False)

    def store(self) -> None:
        """Run all substeps and keep their states."""
        self.rollout.advance(self.begin, self.end, self.states, keep=True)

    def reverse(self) -> None:
        """Run the adjoint of all substeps from the kept states."""
        self.backward.run(self.begin, self.end, self.states)

    def rewind(self) -> None:
        """Reset the start of both runs, and the decisions of the policy; it is not part of a substep, so not timed."""
        self.here[0] = self.states[0] = self.q
        if self.rollout.policy is not None:
            self.rollout.decided = self.control

    def measure(self, repeat: int) -> dict[str, Any]:
        """Return ns per particle and substep in total and for each pass: medians without the first run."""
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
        if not isinstance(self.rollout, UpdatedRollout):  # the reference frame has one sweep in place of passes
            return result
        for each in (*self.forward_passes(), *self.backward_passes()):
            seconds = [timed(lambda: self.rollout.team.run(each.body)) for _ in range(repeat + 1)]  # noqa: B023
            self.backward.q_bar[...] = 0.0
            result["passes"][each.name] = self.nanoseconds(seconds[1:], 1) * each.calls
        return result

    def nanoseconds(self, seconds: list[float], substeps: int) -> float:
        """Return the median per particle and substep [ns]."""
        return float(np.median(seconds)) / (self.n * substeps) * 1e9

    # --- the passes, in an order in which each has its inputs -------------------------------------------------------

    def _at(self, q: Array, q_next: Array, *, ahead: bool = False) -> Substep:
        """Return a substep that sorts its particles and runs all its passes."""
        q_after = self.states[min(2, len(self.states) - 1)]
        return Substep(self.control, 0, False, ahead, q, q_next, self.states[0], q_after)

    def _measurable(self, passes: Sequence[Pass]) -> Iterator[tuple[Pass, float]]:
        """Yield the passes that have work in this scene, and how often each runs per substep."""
        r = self.rollout
        for each in passes:
            if each is not MEET and (r.drive.forces or not each.name.startswith("forces")):
                alone = r.setting.chained and each.tiled  # in a control step's first substep, else with another pass
                yield each, 1.0 / SORT_EVERY if each.name == "sort" else 1.0 / self.substeps if alone else 1.0

    def _body(self, each: Pass, at: Substep) -> Callable[[int], Any]:
        """Return a pass as a function of the thread; its arguments are evaluated once, not while it is timed."""
        r, b = self.rollout, self.backward
        known: dict[str, Any] = {
            "groups": r.groups, "conditions": r.conditions, "drive": r.drive, "run": r.bundle, "pairs": b.pairs,
            "coefficient_bar": b.coefficient_bar, "levels_bar": b.drive_bar.levels, "bars": b.bundle, "at": at,
        }  # fmt: skip
        arguments = [eval(f"({each.arguments},)", known | {"crew": Crew(t, r.threads)}) for t in range(r.threads)]
        return lambda thread: each.run(*arguments[thread])

    def forward_passes(self) -> Iterator[TimedPass]:
        """Yield the passes of a substep."""
        self.rewind()
        self.store()
        r, control, once = self.rollout, self.control, 1.0 / self.substeps
        if r.policy is not None:
            yield TimedPass("policy", alone(self._policy), once)
        if r.drive.stresses or r.drive.steady:
            yield TimedPass("activate", alone(lambda: activate(r.drive, r.fields, r.bundle.push, control)), once)
        q, q_next = self.states[0], self.states[1]
        for each, calls in self._measurable(FORWARD):
            yield TimedPass(each.name, self._body(each, self._at(q, q_next)), calls)
        if r.setting.chained:
            move = next(each for each in FORWARD if each.name == "move")
            yield TimedPass("move_momentum", self._body(move, self._at(q, q_next, ahead=True)), 1.0 - once)
        if r.probe.start.shape[0] > 1:
            rows = np.ones_like(r.records[0])
            yield TimedPass("record", alone(lambda: record(r.probe, q, rows)), once)

    def backward_passes(self) -> Iterator[TimedPass]:
        """Yield the passes of a substep's adjoint, without the passes of the substep that it repeats."""
        r, b, control = self.rollout, self.backward, self.control
        once, rows = 1.0 / self.substeps, np.ones_like(r.records[0])
        if r.probe.start.shape[0] > 1:
            yield TimedPass("record_vjp", alone(lambda: record_vjp(r.probe, b.q_bar, rows)), once)
        q, q_next = self.states[0], self.states[1]
        for each, calls in self._measurable([each for each in BACKWARD if each not in FORWARD]):
            at = self._at(q, q_next) if each.name == "move_vjp" else self._at(q_next, q_next)
            yield TimedPass(each.name, self._body(each, at), calls)
        if r.setting.chained:
            momentum_vjp = next(each for each in BACKWARD if each.name == "momentum_vjp")
            at = self._at(q_next, q_next, ahead=True)
            yield TimedPass("momentum_move_vjp", self._body(momentum_vjp, at), 1.0 - once)
        if r.drive.stresses or r.drive.steady:
            bars = b.drive_bar.levels, r.fields, b.fields_bar, b.bundle.steady_push
            yield TimedPass("activate_vjp", alone(lambda: activate_vjp(b.stresses, r.drive, *bars, control)), once)
        if r.policy is not None:
            yield TimedPass("policy_vjp", alone(self._policy_vjp), once)

    def _policy(self) -> None:
        r, control = self.rollout, self.control
        assert r.policy is not None
        r.policy.act(control, r.sight(control), r.memory[control], lambda: r.unpack(self.q, control))

    def _policy_vjp(self) -> None:
        r, control = self.rollout, self.control
        assert r.policy is not None
        memory = r.memory[control]
        r.policy.act_vjp(
            control, r.sight(control), memory, lambda: r.unpack(self.q, control), np.ones_like(r.activation[control]),
            np.zeros_like(memory), r.policy.parameters_zero(),
        )  # fmt: skip


def alone(run: Callable[[], Any]) -> Callable[[int], Any]:
    """Return a pass that one thread runs while the others wait."""
    return lambda thread: run() if thread == 0 else None


def timed(run: Callable[[], Any]) -> float:
    """Return the time of a call [s]."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin

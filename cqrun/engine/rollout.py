"""A rollout: all substeps of a model, and their adjoint in bounded memory."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any

from checkpoint_schedules import Copy, EndForward, Forward, Move, MultistageCheckpointSchedule, Reverse

from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.checkpoint import Plan, borrowed, make_plan
from cqrun.engine.forward_run import ForwardRun
from cqrun.engine.model import Inputs, LossBar, Model, Records
from cqrun.engine.policy import Policy
from cqrun.plugin.contract import Array
from cqrun.state import State

_ONE = (Forward(0, 1, False, True, None), EndForward(), Reverse(1, 0, True))
"""The schedule of a rollout of one chunk: all its states fit the memory."""


class Rollout(ForwardRun):
    """Run one model with one set of inputs forward, and backward for gradients; see `ForwardRun`.

    Attributes:
        plan: how the last gradient kept its states; None before the first.
        kept_because: why gradients keep states although the frame could run backwards; empty if they do not.
        growth_at: after gradients with a policy, the control step where one grew most; -1 if no loss depends on the
            motion.
        parameters_bar: after `gradient` with a policy, the cotangent of the policy's parameters.
    """

    kept_because: str = ""

    def __init__(
        self, model: Model, inputs: Inputs, *, threads: int = 1, adjoint: bool = False, policy: Policy | None = None
    ) -> None:
        super().__init__(model, inputs, threads=threads, adjoint=adjoint, policy=policy)
        self.plan: Plan | None = None
        self.growth_at = -1
        self.parameters_bar: Any = None

    @abstractmethod
    def backward(self, loss_bar: LossBar) -> BackwardRun:
        """Return the backward run from the cotangents of the results."""

    def remarks(self) -> list[str]:
        """Return sentences about what a user should know of the motion so far."""
        return []

    def expected_plan(self) -> Plan:
        """Return how a gradient would keep its states; raise RunError if it does not fit the memory."""
        return make_plan(self.model.n_steps, self.state_bytes, self.model.memory_budget)

    def gradient(self, loss_bar: Callable[[Records, State], LossBar]) -> tuple[Records, Inputs]:
        """Run forward and backward; return the records and the cotangent of the inputs.

        Args:
            loss_bar: returns the loss's cotangents for the records and the final state.
        """
        records, (sweep,) = self.gradients(lambda records, final: [loss_bar(records, final)])
        self.parameters_bar = sweep.parameters_bar
        return records, sweep.inputs_bar()

    def gradients(self, loss_bars: Callable[[Records, State], Iterable[LossBar]]) -> tuple[Records, list[BackwardRun]]:
        """Run forward once, and backward once for each of several functions; return the records and the sweeps.

        The functions share the states that are computed again.

        Args:
            loss_bars: returns each function's cotangents for the records and the final state; may be an iterator.
        """
        model = self.model
        plan = self.plan = self.expected_plan()
        with borrowed(model.spare, (plan.states, *self.start.shape), model.real) as states:
            records, sweeps = self._sweep(plan, states, loss_bars)
        self.growth_at = max((sweep.growth for sweep in sweeps), default=(0.0, -1))[1]
        return records, sweeps

    def _sweep(
        self, plan: Plan, states: Array, loss_bars: Callable[[Records, State], Iterable[LossBar]]
    ) -> tuple[Records, list[BackwardRun]]:
        """Run forward and backward by the plan, in the memory for its states."""
        model, n_steps = self.model, self.model.n_steps
        chunk_states, spare = states[: plan.chunk + 1], list(states[plan.chunk + 1 :])
        snapshots: dict[int, Array] = {}
        current = self.start[None].copy()
        sweeps: list[BackwardRun] = []
        schedule = MultistageCheckpointSchedule(plan.n_chunks, plan.snapshots, 0) if plan.n_chunks > 1 else _ONE

        def ends(chunk: int) -> int:
            return min(chunk * plan.chunk, n_steps)

        for action in schedule:
            if isinstance(action, Forward):
                if action.write_ics:
                    snapshots[action.n0] = spare.pop()
                    snapshots[action.n0][...] = current[0]
                last = action.n1 - 1 if action.write_adj_deps else action.n1
                self.advance(ends(action.n0), ends(last), current, keep=False)
                if action.write_adj_deps:
                    chunk_states[0] = current[0]
                    self.advance(ends(last), ends(action.n1), chunk_states, keep=True)
            elif isinstance(action, EndForward):
                self.final = chunk_states[n_steps - ends(plan.n_chunks - 1)].copy()
                records = self.read_records()
                sweeps += [self.backward(bar) for bar in loss_bars(records, self.unpack(self.final, model.n_controls))]
            elif isinstance(action, Reverse):
                for sweep in sweeps:
                    sweep.run(ends(action.n0), ends(action.n1), chunk_states)
            elif isinstance(action, (Copy, Move)):
                current[0] = snapshots[action.n]
                if isinstance(action, Move):
                    spare.append(snapshots.pop(action.n))
        return records, sweeps

"""A rollout: the model's equations run over all substeps, and its adjoint in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from checkpoint_schedules import Copy, EndForward, EndReverse, Forward, Move, MultistageCheckpointSchedule, Reverse

from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.checkpoint import Plan, borrowed, make_plan
from cqrun.engine.forward_run import ForwardRun
from cqrun.engine.model import Inputs, LossBar, Model, Records
from cqrun.engine.policy import Policy
from cqrun.plugin.contract import Array
from cqrun.state import State

_ONE = (
    Forward(0, 1, False, True, None),
    EndForward(),
    Reverse(1, 0, True),
    EndReverse(),
)
"""The schedule of a rollout whose states all fit."""


class Rollout(ForwardRun):
    """One model with one set of inputs: run forward, and backward for gradients.

    Arguments, attributes and errors are those of `ForwardRun`, and:

    Attributes:
        plan: how the last gradient kept its states; None before the first.
        growth_at: after gradients under a policy, the control step where one grew most; -1 if no load depends on the
            motion.
        parameters_bar: after `gradient` under a policy, the cotangent of the policy's parameters.
    """

    def __init__(
        self, model: Model, inputs: Inputs, *, threads: int = 1, adjoint: bool = False, policy: Policy | None = None
    ) -> None:
        super().__init__(model, inputs, threads=threads, adjoint=adjoint, policy=policy)
        self.plan: Plan | None = None
        self.growth_at = -1
        self.parameters_bar: Any = None

    def gradient(self, loss_bar: Callable[[Records, State], LossBar]) -> tuple[Records, Inputs]:
        """Run forward and backward; return the records and the cotangent of the inputs.

        That of the policy's parameters, if there is a policy, is then in `parameters_bar`.

        Args:
            loss_bar: given the records and the final state, returns the loss's cotangents.
        """
        records, (sweep,) = self.gradients(lambda records, final: [loss_bar(records, final)])
        self.parameters_bar = sweep.parameters_bar
        return records, sweep.inputs_bar()

    def gradients(self, loss_bars: Callable[[Records, State], Iterable[LossBar]]) -> tuple[Records, list[BackwardRun]]:
        """Run forward once, and backward once for each of several functions; return the records and the sweeps.

        States that were not kept are computed again once, whatever the number of functions.

        Args:
            loss_bars: given the records and the final state, returns each function's cotangents; from an iterator
                one is taken after the other, and not kept.
        """
        model = self.model
        n_steps = model.n_steps
        plan = self.plan = make_plan(n_steps, self.state_bytes, model.memory_budget)
        with borrowed(model.spare, (plan.states, *self.start.shape), model.real) as states:
            records, sweeps = self._sweep(plan, states, loss_bars)
        self.growth_at = max((sweep.growth for sweep in sweeps), default=(0.0, -1))[1]
        return records, sweeps

    def _sweep(
        self, plan: Plan, states: Array, loss_bars: Callable[[Records, State], Iterable[LossBar]]
    ) -> tuple[Records, list[BackwardRun]]:
        """Run forward and backward as planned, with memory for the plan's states."""
        model = self.model
        n_steps = model.n_steps
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
                final = chunk_states[n_steps - ends(plan.n_chunks - 1)]
                records = Records.from_rows(self.records.copy(), model.layout.table)
                sweeps += [BackwardRun(self, bar) for bar in loss_bars(records, self.unpack(final, model.n_controls))]
            elif isinstance(action, Reverse):
                for sweep in sweeps:
                    sweep.run(ends(action.n0), ends(action.n1), chunk_states)
            elif isinstance(action, (Copy, Move)):
                current[0] = snapshots[action.n]
                if isinstance(action, Move):
                    spare.append(snapshots.pop(action.n))
            if isinstance(action, EndReverse):
                break
        return records, sweeps

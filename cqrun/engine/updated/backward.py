"""The backward run in the updated frame: cotangents of the particles, from the last substep to the first."""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.probe import record_vjp
from cqrun.engine.setting import Crew
from cqrun.engine.updated.setting import Bars
from cqrun.engine.updated.step import reverse
from cqrun.numerics.packed import pack, unpack
from cqrun.plugin.contract import Array
from cqrun.state import State


class UpdatedBackward(BackwardRun):
    """Run a rollout of the updated frame backward; see `BackwardRun`."""

    rollout: Any

    def _make_bars(self) -> None:
        run, model = self.rollout.bundle, self.rollout.model
        push_bar = np.zeros_like(run.push)
        self.bundle = Bars(self.q_bar, self.fields_bar, push_bar, model.no_push(self.rollout.drive.steady))

    def _add_state(self, bar: State) -> None:
        layout, real = self.rollout.model.layout, self.rollout.model.real
        self.q_bar += pack(unpack(bar.pack_bar(layout, real)) * layout.real(), real)

    def _add_record(self, q_bar: Array, record_bar: Array) -> None:
        record_vjp(self.rollout.probe, q_bar, record_bar)

    def _reverse(self, begin: int, end: int, states: Array) -> None:
        r = self.rollout

        def body(thread: int, from_: int = begin, n: int = r.threads) -> None:
            reverse(
                r.groups, self.pairs, r.conditions, self.coefficient_bar, r.drive, self.stresses, self.drive_bar.levels,
                r.bundle, self.bundle, states, from_, end, r.probe, self.records_bar, Crew(thread, n),
            )  # fmt: skip

        if r.threads > 1:
            body(0, end, 1)
        r.team.run(body)

    def _state_bar(self) -> State:
        return State.unpack(self.q_bar, self.rollout.model.layout, self.memory_bar)

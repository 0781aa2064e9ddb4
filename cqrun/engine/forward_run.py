"""The forward run of a rollout in any frame: control steps, the policy's decisions, and what is recorded."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import config

from cqrun.engine.model import Inputs, Model, Records
from cqrun.engine.policy import Policy, Sight
from cqrun.engine.setting import Drive, Group, Probe
from cqrun.engine.suspects import group_of
from cqrun.engine.team import Team
from cqrun.errors import RolloutError
from cqrun.forces.pulled import pulled_lanes
from cqrun.materials.term import has_history, in_motion, limit_of
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import pack
from cqrun.plugin.contract import Array
from cqrun.state import DECAY, FORCE, MASS, VOLUME, ParticleFields, State

THREAD_WORTH = 1000
"""Number of particles per thread from which one more thread saves more time than the exchange of the grid costs."""

CALL_WORTH = 2500
"""The same for particles times substeps of a control step, because threads are often woken at every control step."""


def useful_threads(model: Model, threads: int) -> int:
    """Return how many of the threads have enough work in a rollout."""
    if config.DISABLE_JIT:  # without the JIT there is no barrier
        return 1
    n, substeps = model.layout.n_particles, model.substeps
    return max(1, min(threads, n // THREAD_WORTH, n * substeps // CALL_WORTH))


class ForwardRun(ABC):
    """Run one model forward with one set of inputs. A subclass for each frame has the packed state and the kernels.

    Args:
        threads: number of threads at most; small models use fewer. The results do not depend on it.
        adjoint: whether `Rollout.gradient` will be called.
        policy: decides the activations at every control step; without it the activations are those of the inputs.

    Attributes:
        start: the packed state at the start, in the frame's own form.
        final: the same at the end of the last run; the start before the first.
        memory: (T + 1, M) memory of the policy at every control step.
        decided: number of control steps whose activations are known.

    Raises:
        RolloutError: (from `run`) a particle left the grid or is not finite.
    """

    start: Array
    fields: Array
    drive: Drive
    groups: tuple[Group, ...]
    conditions: tuple[Any, ...]
    probe: Probe
    final: Array

    def __init__(
        self, model: Model, inputs: Inputs, *, threads: int = 1, adjoint: bool = False, policy: Policy | None = None
    ) -> None:
        self.model, self.inputs = model, inputs
        self.adjoint, self.policy = adjoint, policy
        self.team = Team(useful_threads(model, threads))
        self._pack()
        self.final = self.start
        self.records: Array = np.zeros((model.n_controls + 1, model.layout.table.n_rows, len(self.probe.start) - 1))
        self._record_start()
        self.memory = np.tile(inputs.state.memory, (model.n_controls + 1, 1))
        self.decided = model.n_controls if policy is None else 0

    @property
    def activation(self) -> Array:
        """Activations (T, A) of the actuators, one row per control step."""
        return self.drive.levels.activation[:, : len(self.model.actuators)]

    @property
    def state_bytes(self) -> int:
        """Bytes of one kept state."""
        return int(self.start.nbytes)

    @property
    def threads(self) -> int:
        """Number of threads in use."""
        return self.team.size

    @abstractmethod
    def _pack(self) -> None:
        """Set the kernels' arguments from the model and the inputs."""

    @abstractmethod
    def _record_start(self) -> None:
        """Write the record of the start."""

    @abstractmethod
    def unpack(self, q: Array, control: int) -> State:
        """Return a packed state of a control step as a State."""

    @abstractmethod
    def _advance(self, begin: int, end: int, states: Array, keep: bool) -> None:
        """Run substeps whose activations are known; see `advance`."""

    def _pack_fields(self, fields: ParticleFields) -> Array:
        """Return the 3 + D packed rows of the fields; padding has no mass, no volume and no force."""
        layout, columns = self.model.layout, self.model.layout.columns()
        out = np.zeros((FORCE + layout.dim, layout.n))
        out[MASS, columns], out[VOLUME, columns] = fields.mass, fields.volume
        out[DECAY] = 1.0
        out[DECAY, columns] = np.exp(-fields.damping * self.model.dt)
        out[FORCE:, columns] = fields.force.T
        return pack(out, self.model.real)

    def kernel_groups(self, terms: list[list[Array]], drive: Drive) -> tuple[Group, ...]:
        """Return the kernels' view of every group; the drive fills the parameters of the active stresses."""
        model, groups = self.model, []
        active = dict(zip(model.kinds()[0], drive.stresses, strict=True))
        starts, sources = np.cumsum([0, *model.layout.padded]), model.layout.sources()
        for g, slice_, thetas in zip(model.groups, model.group_slices(), terms, strict=True):
            lo, hi = int(starts[g.bodies[0]]), int(starts[g.bodies[-1] + 1])
            views, histories = [], g.history or ((),) * len(g.kernel_terms)
            for make, theta, names in zip(g.kernel_terms, thetas, histories, strict=True):
                full = np.zeros((len(theta), model.layout.n))
                full[:, lo:hi] = theta[:, sources[lo:hi] - slice_.start]
                view = make(pack(full, model.real))
                view = view if model.static else in_motion(view, model.dt)
                views.append(view._replace(history=self._rows(names)) if has_history(type(view)) else view)
            views += [kind(active[kind].theta, (0,) * active[kind].theta.shape[1]) for kind in g.active]
            lanes = tuple(pulled_lanes(pulled.columns, lo, hi, lane_width(model.real)) for pulled in drive.pulled)
            groups.append(Group(lo, hi, tuple(views), lanes))
        return tuple(groups)

    def _rows(self, names: tuple[str, ...]) -> tuple[int, ...]:
        """Return the rows of the state with the named fields."""
        rows = self.model.layout.table.rows
        return tuple(row for name in names for row in range(rows[name].start, rows[name].stop))

    def _check_masses(self) -> None:
        # a node whose mass is NaN counts as empty: its particles would stand still without an error
        infinite = np.flatnonzero(~np.isfinite(self.inputs.fields.mass))
        if len(infinite):
            self._report(int(infinite[0]), 0, "its mass is not finite", "check its density and attached masses")

    def run(
        self, observe: Callable[[int, State], None] | None = None, should_stop: Callable[[], bool] | None = None
    ) -> Records:
        """Run all substeps and return the probe's records; after an early end the rest of them is not filled.

        Args:
            observe: called with (control step, state) at control steps 0 .. T.
            should_stop: called between control steps; if it returns True, the run ends early.
        """
        states = self.start[None].copy()
        n = self.model.n_controls
        for control in range(n + 1):
            if observe is not None:
                observe(control, self.unpack(states[0], control))
            if control == n or (should_stop is not None and should_stop()):
                break
            self.advance(control * self.model.substeps, (control + 1) * self.model.substeps, states, keep=False)
        self.final = states[0]
        return self.read_records()

    def activation_at(self, step: int) -> Array:
        """Return the activations (A,) of the control step to which a substep belongs."""
        control = min(max(step - 1, 0) // self.model.substeps, self.model.n_controls - 1)
        return np.asarray(self.activation[control])

    def read_records(self) -> Records:
        """Return a copy of the probe's records so far; the rest of them is not filled."""
        return Records.from_rows(self.records.copy(), self.model.layout.table)

    def held_at(self, control: int) -> dict[str, Array]:
        """Return force and moment of every recorded boundary in the control step that ended at `control`, by name."""
        return {}

    def rigid_at(self, control: int) -> dict[str, Array]:
        """Return what is seen of every rigid body at a control step, by name; see `Records.rigid`."""
        return {}

    def sight(self, control: int) -> Sight:
        """Return what a policy sees at the start of a control step that has been reached."""
        levels = self.drive.levels
        before = self.activation[control - 1] if control > 0 else np.zeros(len(self.model.actuators))
        return Sight(
            self.records[control], self.rigid_at(control), self.held_at(control), before, levels.strength, levels.rest,
            levels.friction,
        )  # fmt: skip

    def advance(self, begin: int, end: int, states: Array, *, keep: bool) -> None:
        """Run substeps begin .. end from states[0]; with `keep`, states[k] becomes the state after k of them.

        The policy decides each control step once; a repeated run uses its decisions.
        """
        at, substeps = begin, self.model.substeps
        while at < end:
            here = states[at - begin :] if keep else states
            if at == self.decided * substeps:
                self._decide(self.decided, here[0])
            to = min(end, self.decided * substeps)
            self._advance(at, to, here, keep)
            at = to

    def _decide(self, control: int, q: Array) -> None:
        assert self.policy is not None
        self.activation[control], self.memory[control + 1] = self.policy.act(
            control, self.sight(control), self.memory[control], lambda: self.unpack(q, control)
        )
        self.decided = control + 1

    def _with_limit(self, advice: str, particle: int) -> str:
        """Return advice about a particle that is not finite, with the limit of its law if that has one."""
        body = next(k for k, part in enumerate(self.model.layout.slices()) if particle < part.stop)
        law = next(own for own, g in zip(self.groups, self.model.groups, strict=True) if body in g.bodies).terms[0]
        return "; ".join(filter(None, [advice, limit_of(type(law))]))

    def _report(self, particle: int, step: int, reason: str, advice: str) -> None:
        slices, time = self.model.layout.slices(), step * self.model.dt
        name, part = next((n, s) for n, s in zip(self.model.body_names, slices, strict=True) if particle < s.stop)
        group = group_of(self.model, particle)
        raise RolloutError(reason, body=name, particle=particle - part.start, group=group, time=time, advice=advice)

"""The forward run of a rollout: all substeps, from packed inputs to records."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import config

from cqrun.engine.model import Inputs, Model, Records
from cqrun.engine.policy import Policy
from cqrun.engine.probe import record
from cqrun.engine.setting import MARGIN, Crew, Drive, Group, Run, Setting, make_work, node_strides
from cqrun.engine.step import advance
from cqrun.engine.team import Team
from cqrun.errors import RolloutError
from cqrun.forces.pulled import pulled_lanes
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import pack, unpack
from cqrun.plugin.contract import Array
from cqrun.state import DECAY, FORCE, MASS, VOLUME, ParticleFields, State

THREAD_WORTH = 1000
"""Number of particles per thread from which one more thread saves more time than the exchange of the grid costs."""

CALL_WORTH = 2500
"""The same for particles times substeps of a control step, because threads are often woken at every control step."""

CHAINED_FROM = 3 << 20
"""Bytes of a state from which substeps are chained tile by tile: from about here a substep exceeds the last cache."""


def useful_threads(model: Model, threads: int) -> int:
    """Return how many of the threads have enough work in a rollout."""
    if config.DISABLE_JIT:  # without the JIT there is no barrier
        return 1
    n, substeps = model.layout.n_particles, model.substeps
    return max(1, min(threads, n // THREAD_WORTH, n * substeps // CALL_WORTH))


class ForwardRun:
    """Run one model forward with one set of inputs.

    Args:
        threads: number of threads at most; small models use fewer. The results do not depend on it.
        adjoint: whether `Rollout.gradient` will be called.
        policy: decides the activations at every control step; without it the activations are those of the inputs.

    Attributes:
        memory: (T + 1, M) memory of the policy at every control step.
        decided: number of control steps whose activations are known.

    Raises:
        RolloutError: (from `run`) a particle left the grid or is not finite.
    """

    def __init__(
        self, model: Model, inputs: Inputs, *, threads: int = 1, adjoint: bool = False, policy: Policy | None = None
    ) -> None:
        self.model, self.inputs = model, inputs
        self.adjoint, self.policy = adjoint, policy
        self.team = Team(useful_threads(model, threads))
        self._pack()
        self.records: Array = np.zeros((model.n_controls + 1, model.layout.table.n_rows, len(self.probe.start) - 1))
        record(self.probe, self.start, self.records[0])
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
                views.append(view._replace(history=self._rows(names)) if names else view)
            views += [kind(active[kind].theta, (0,) * active[kind].theta.shape[1]) for kind in g.active]
            lanes = tuple(pulled_lanes(pulled.columns, lo, hi, lane_width(model.real)) for pulled in drive.pulled)
            groups.append(Group(lo, hi, tuple(views), lanes))
        return tuple(groups)

    def _rows(self, names: tuple[str, ...]) -> tuple[int, ...]:
        """Return the rows of the state with the named fields."""
        rows = self.model.layout.table.rows
        return tuple(row for name in names for row in range(rows[name].start, rows[name].stop))

    def _check_start(self) -> None:
        astray = self._astray(self.start)
        if astray.any():
            self._fail(int(np.flatnonzero(astray)[0]), 0, self.start)
        # a node whose mass is NaN counts as empty: its particles would stand still without an error
        infinite = np.flatnonzero(~np.isfinite(self.inputs.fields.mass))
        if len(infinite):
            self._report(int(infinite[0]), 0, "its mass is not finite", "check its density and attached masses")

    def _astray(self, q: Array) -> Array:
        """Return for each kernel column whether its particle is off the grid or not finite (n,)."""
        x = unpack(q)[: self.model.dim] / self.model.dx + MARGIN
        return ~np.all((x > 1.0) & (x < np.array(self.setting.upper)[:, None]), axis=0)

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
        return Records.from_rows(self.records, self.model.layout.table)

    def unpack(self, q: Array, control: int) -> State:
        """Return a packed state of a control step as a State."""
        return State.unpack(q, self.model.layout, self.memory[control])

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
            control, self.records[control], self.memory[control], lambda: self.unpack(q, control)
        )
        self.decided = control + 1

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
        x = unpack(q)[: self.model.dim, column]
        if np.isfinite(x).all():
            reason = f"left the grid at {np.array2string(x.astype(float), precision=4)} m"
            advice = "enlarge the world, add a boundary at its faces, or reduce what drives the body out"
        else:
            reason = "its position is not finite"
            advice = "the simulation blew up: use smaller substeps, a softer material or weaker actuation"
        self._report(int(self.model.layout.sources()[column]), step, reason, advice)

    def _report(self, particle: int, step: int, reason: str, advice: str) -> None:
        slices, time = self.model.layout.slices(), step * self.model.dt
        name, part = next((n, s) for n, s in zip(self.model.body_names, slices, strict=True) if particle < s.stop)
        raise RolloutError(reason, body=name, particle=particle - part.start, time=time, advice=advice)

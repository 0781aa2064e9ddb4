"""The backward run in the reference frame: cotangents of the nodes' motion, from the last substep to the first."""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.boundaries.condition import project_all_vjp
from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.model import Inputs, LossBar
from cqrun.engine.policy import SightBar
from cqrun.engine.probe import record_vjp
from cqrun.engine.reference.contacts import add_friction_bars, add_rigid_bars, rest_bars, rigid_of, with_own_bars
from cqrun.engine.reference.corners import add_means_bar, with_bars
from cqrun.engine.reference.ghost import GAMMA, mean_modulus, mean_modulus_vjp
from cqrun.engine.reference.history import rows_of_state, rows_of_table
from cqrun.engine.reference.history import with_bars as with_histories_bars
from cqrun.engine.reference.moves import poses_vjp
from cqrun.engine.reference.placing import note_all_poses_vjp
from cqrun.engine.reference.poses import glue_vjp
from cqrun.engine.reference.reactions import add_bars_at, columns, zero_bars_of
from cqrun.engine.reference.rigid import add_record_bars
from cqrun.engine.reference.setting import NodeBars
from cqrun.engine.reference.shape import make_shape_bars, motion_bar
from cqrun.engine.reference.step import reverse, see_vjp
from cqrun.engine.setting import Crew
from cqrun.numerics.packed import aligned, pack, unpack
from cqrun.plugin.contract import Array
from cqrun.state import DECAY, MASS, State


class ReferenceBackward(BackwardRun):
    """Run a rollout of the reference frame backward; see `BackwardRun`.

    Args:
        reverses: whether it finds each state from the next one; `run` then gets one state, that at its end, and
            turns it into the one at its beginning.
    """

    rollout: Any

    def __init__(self, rollout: Any, loss_bar: LossBar, *, reverses: bool) -> None:
        self.reverses = reverses
        super().__init__(rollout, loss_bar)

    def _make_bars(self) -> None:
        r, run = self.rollout, self.rollout.bundle
        n_nodes, real = len(run.nodes.mass), run.force.dtype
        u_bar, v_bar = self.q_bar
        pairs, sums, outside = (aligned((count * n_nodes, 4), real) for count in (2, 2, 1))
        mass_bar, kept_bar = np.zeros(n_nodes), np.zeros(n_nodes)
        ghost_bar = np.zeros(sum(len(ghost.scale) for ghost in r.ghosts))
        self.bundle = NodeBars(
            u_bar, v_bar, pairs, sums, mass_bar, kept_bar, ghost_bar, outside, self.fields_bar,
            aligned(run.q.shape, real), r.model.no_push(r.drive.steady), self.coefficient_bar,
            make_shape_bars(r),
        )  # fmt: skip
        self.trial = self.bundle._replace(shape=make_shape_bars(r))  # for sums that do not count
        self.means = tuple(with_bars(r, g, bar) for g, bar in enumerate(self.groups_bar))
        self.parts = tuple(
            (pair, means, *bodies) for pair, means, (_, _, *bodies) in zip(self.pairs, self.means, r.parts, strict=True)
        )
        self.histories = with_histories_bars(r.histories, r.groups, self.groups_bar)
        self.moves = tuple((moves, np.zeros_like(moves.pose)) for moves in r.moves)
        self.reactions = tuple((reactions, zero_bars_of(reactions)) for reactions in r.reactions)
        mean_bar = self.reactions[0][1].mean if self.reactions else np.zeros((0, 0, 0))
        self.contacts = with_own_bars(r.contacts, r.model, r.inputs, mean_bar)
        self.finished = False

    def _begin(self, loss_bar: LossBar) -> None:
        super()._begin(loss_bar)
        held_bar, model = {} if loss_bar.records is None else loss_bar.records.held, self.rollout.model
        for _, bars in self.reactions:
            for name, bar in held_bar.items():
                bars.mean[:, model.reactions.index(name), columns(model.dim)] = bar[1:]
        for rigid in rigid_of(self.contacts) if loss_bar.records is not None else ():
            add_record_bars(rigid, model, loss_bar.records.rigid)

    def _add_sight(self, control: int, bar: SightBar) -> None:
        super()._add_sight(control, bar)
        model = self.rollout.model
        if bar.held is not None:
            add_bars_at(self.reactions, model, control, bar.held)
        for rigid in rigid_of(self.contacts) if bar.rigid is not None else ():
            add_record_bars(rigid, model, bar.rigid, control)

    def _from(self, states: Array, k: int) -> Array:
        """Return the kept states from the k-th on; a run that reverses has one state."""
        return states if self.reverses else states[k:]

    def _see(self, q_bar: Array) -> None:
        """Add the adjoint of what is seen of the state `here`, at bundle.q, to the cotangent of the nodes' motion."""
        crew, colours = Crew(0, 1), self.rollout.rest.patches.colours
        bars = self.bundle if q_bar is self.q_bar else self.trial
        see_vjp(self.rollout.bundle, bars, colours, self.here[0], self.here[1], q_bar[0], q_bar[1], crew)
        for each in self.histories:
            q_bar[:, each.begin :] += rows_of_state(self.bundle.q, each.first)
            self.bundle.q[:, each.first :] = 0.0

    def _add_state(self, bar: State) -> None:
        layout, real = self.rollout.model.layout, self.rollout.model.real
        self.bundle.q[...] = pack(unpack(bar.pack_bar(layout, real)) * layout.real(), real)
        self._see(self.q_bar)

    def _add_record(self, q_bar: Array, record_bar: Array) -> None:
        if record_bar.any():
            record_vjp(self.rollout.probe, self.bundle.q, record_bar)
            self._see(q_bar)

    def _reverse(self, begin: int, end: int, states: Array) -> None:
        r = self.rollout

        def body(thread: int, from_: int = begin, n: int = r.threads) -> None:
            reverse(
                self.parts, self.histories, r.conditions, r.loads, r.ghosts, self.moves, self.reactions,
                self.contacts, r.drive, self.stresses, self.drive_bar.levels, r.bundle, self.bundle,
                r.rest.patches.colours, states, from_, end, self.reverses, r.probe, self.records_bar, Crew(thread, n),
            )  # fmt: skip

        if r.threads > 1:
            body(0, end, 1)
        r.team.run(body)
        for each in self.histories:  # in the state's cotangent now
            self.bundle.q[:, each.first :] = 0.0

    def inputs_bar(self) -> Inputs:
        """Return the cotangent of the inputs."""
        bar, r = super().inputs_bar(), self.rollout
        add_rigid_bars(self.contacts, r.model, r.inputs, self.q_bar, bar)
        if r.ghosts:
            self._add_ghost_bar(bar)
        for _, pose_bar in self.moves:
            bar.moves += poses_vjp(r.model, r.inputs.moves, r.shares, pose_bar)
            bar.waypoints += glue_vjp(r.model, pose_bar, r.inputs.waypoints)
        for g, means in enumerate(self.means):
            add_means_bar(means, r, g, bar)
        surface_bar, x_bar = rest_bars(self.contacts, r)
        bar.state.x += x_bar
        if len(bar.surface):
            bar.surface += surface_bar
        return bar

    def _add_ghost_bar(self, bar: Inputs) -> None:
        """Add what the ghost penalty's scale, gamma mu fill dx^(D-2), gives to parameters and volumes."""
        r, runs, dx, dim = self.rollout, self.rollout.runs, self.rollout.model.dx, self.rollout.model.dim
        body, modulus = r.rest.patches.body_of_nodes()[runs.lightest], mean_modulus(r.model, r.inputs)
        scale_bar = GAMMA * dx ** (dim - 2) * self.bundle.ghost
        mean_modulus_vjp(r.model, r.inputs, np.bincount(body, scale_bar * runs.fill, len(modulus)), bar)
        volume_bar = np.bincount(runs.lightest, scale_bar * modulus[body] / dx**dim, len(r.bundle.nodes.mass))
        bar.fields.volume += r.rest.to_particles(volume_bar[:, None])[0][:, 0]
        if r.inputs.shaped:
            bar.state.x += r.rest.to_nodes_vjp(volume_bar[:, None], r.inputs.fields.volume[:, None])

    def _state_bar(self) -> State:
        """Return the cotangent of the start; that of the rest positions has all but ghosts, means and contact."""
        start, run, model = self.rollout.inputs.state, self.rollout.bundle, self.rollout.model
        bar, dim, active = start.zeros_like(), model.dim, run.nodes.active
        bar.memory[:] = self.memory_bar
        v_bar = np.zeros((len(run.nodes.mass), dim))
        v_bar[active] = self.q_bar[1][active, :dim]
        mass_bar = self.bundle.mass.copy()
        mass_bar[active] -= (
            np.einsum("nd,nd->n", v_bar, self.rollout.start[1][: len(v_bar), :dim])[active] / run.nodes.mass[active]
        )
        for n in active[run.nodes.bits[active] != 0]:
            free, bits = tuple(self.rollout.free_start[n]), int(run.nodes.bits[n])
            v_bar[n] = project_all_vjp(self.rollout.conditions, n, bits, free, tuple(v_bar[n]), self.coefficient_bar, 0)
        v_bar[active] /= run.nodes.mass[active, None]
        value, moment = self.rollout.rest.to_particles(v_bar)
        m = self.rollout.inputs.fields.mass
        bar.v[:], bar.C[:] = m[:, None] * value, m[:, None, None] * moment * model.dx
        self._add_histories(bar)
        momentum = np.einsum("nd,nd->n", value, start.v) + model.dx * np.einsum("nde,nde->n", moment, start.C)
        if not self.finished:
            for contact in self.contacts.obstacles:
                note_all_poses_vjp(contact, run, self.bundle, *self.rollout.start, 0, Crew(0, 1))
            add_friction_bars(self.contacts, self.rollout.model, self.coefficient_bar)
            self._finish_masses(mass_bar, momentum)
        if self.rollout.inputs.shaped:
            bar.x[:] = self._rest_bar(mass_bar, v_bar)
        return bar

    def moving_bar(self) -> Array:
        """Return the cotangent of the rest positions (N, D) from substeps and looks; zero if it is not wanted."""
        zero = np.zeros(self.rollout.rest.x.shape)
        return sum((motion_bar(self.rollout, shape) for shape in self.bundle.shape), zero)

    def _rest_bar(self, mass_bar: Array, v_bar: Array) -> Array:
        """Return that cotangent with what masses and momentum at the start give."""
        inputs, rest, model = self.rollout.inputs, self.rollout.rest, self.rollout.model
        m, state = inputs.fields.mass, inputs.state
        kept = np.exp(-inputs.fields.damping * model.dt) * m
        bars = np.stack([mass_bar, self.bundle.kept], axis=1)
        momentum = m[:, None] * state.v, m[:, None, None] * state.C * model.dx
        return (
            self.moving_bar()
            + rest.to_nodes_vjp(bars, np.stack([m, kept], axis=1))
            + rest.to_nodes_vjp(v_bar, *momentum)
        )

    def _add_histories(self, bar: State) -> None:
        """Write the cotangents of the histories at the start to that of the state."""
        layout = self.rollout.model.layout
        for each in self.histories:
            h = rows_of_table(self.q_bar[:, each.begin :], layout.table.n_rows - each.first)[:, layout.columns()]
            for name, array in bar.history.items():
                rows = layout.table.rows[name]
                array[...] = h[rows.start - each.first : rows.stop - each.first].T.reshape(array.shape)

    def _finish_masses(self, mass_bar: Array, momentum: Array) -> None:
        """Add the cotangents of the nodes' masses, and of the momentum at the start, to those of the particles."""
        inputs, model, self.finished = self.rollout.inputs, self.rollout.model, True
        bars = self.rollout.rest.to_particles(np.stack([mass_bar, self.bundle.kept], axis=1))[0]
        columns = model.layout.columns()
        f = unpack(self.fields_bar)
        f[MASS, columns] += bars[:, 0] + np.exp(-inputs.fields.damping * model.dt) * bars[:, 1] + momentum
        f[DECAY, columns] += inputs.fields.mass * bars[:, 1]
        self.fields_bar[...] = pack(f, self.fields_bar.dtype)

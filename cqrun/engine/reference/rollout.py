"""Rollouts in the reference frame: the state is the motion of the nodes, u and v; the weights never change.

A gradient runs the substeps backwards where that is exact, and keeps only a few states to start again from. It keeps
checkpoints as the other frame does where the motion loses what a reversed run would need: with stresses or forces that
depend on velocities, with histories, and with strong damping.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from cqrun.boundaries.condition import project_all
from cqrun.engine.backward_run import BackwardRun
from cqrun.engine.checkpoint import Plan
from cqrun.engine.model import LossBar, Records, riding_at
from cqrun.engine.reference.backward import ReferenceBackward
from cqrun.engine.reference.contacts import clear_slid, has_slid, make_contacts, rigid_of
from cqrun.engine.reference.corners import make_means
from cqrun.engine.reference.ghost import GAMMA, Ghost, kernel_ghost, mean_modulus
from cqrun.engine.reference.history import make_histories, put_histories, rows_of_state
from cqrun.engine.reference.look import look
from cqrun.engine.reference.moves import Moves, moving_nodes, parts_of, poses, progress
from cqrun.engine.reference.placing import note_all_poses
from cqrun.engine.reference.points import riding_points
from cqrun.engine.reference.poses import glue
from cqrun.engine.reference.reactions import (
    Reactions,
    make_reactions,
    reactions_at,
    reactions_by_name,
    rows_of_impulses,
)
from cqrun.engine.reference.remarks import most_stretched, remarks_on, why_it_failed
from cqrun.engine.reference.rest import rest_geometry
from cqrun.engine.reference.rigid import meeting_error, poses_by_name, put_start
from cqrun.engine.reference.setting import TILE, NodeRun, Nodes, NodeSetting, PointLoads, Tiles
from cqrun.engine.reference.step import advance, note
from cqrun.engine.reference.stretch import no_watch
from cqrun.engine.rigid_model import ROWS, count_free
from cqrun.engine.rollout import Rollout
from cqrun.engine.setting import Crew
from cqrun.forces.force import needs_velocity
from cqrun.forces.pulled import Pulled
from cqrun.materials.term import needs_rate
from cqrun.numerics.packed import aligned, pack
from cqrun.plugin.contract import Array
from cqrun.state import PADDING, State

MOST_GROWTH = 15.0
"""exp of this is how much a reversed run may magnify rounding: damping that runs backwards grows."""

SNAPSHOTS = 64 << 20
"""Bytes of the states that a reversed run keeps to start again from; without a bound it would keep every state."""

FEWEST_STEPS = 200
"""Substeps that a reversed run covers from one kept state, even if there is memory for more states."""

FLOAT32_STEPS = 64
"""Substeps after which a reversed run in float32 starts again, because its rounding is coarse."""


LOOK_FOR_CONTACT = 64
"""Substeps after which a run that may be reversed looks whether contact has made that impossible."""


class ReferenceRollout(Rollout):
    """Run one model in the reference frame; see `Rollout`.

    Attributes:
        reversible: whether gradients run the substeps backwards.
    """

    def _pack(self) -> None:
        model, inputs = self.model, self.inputs
        if not np.array_equal(inputs.state.F, np.broadcast_to(np.eye(model.dim), inputs.state.F.shape)):
            raise ValueError("a rollout in the reference frame starts from the rest shape, F = I")
        self.rest = rest_geometry(model, inputs.state.x)
        patches = self.rest.patches
        self.model = model = replace(model, layout=patches.layout)
        self._check_masses()
        self.fields = self._pack_fields(inputs.fields)
        self.drive = model.kernel_drive(inputs)
        self.groups = self.kernel_groups(inputs.terms, self.drive)
        self.conditions = self.rest.conditions(model, inputs.coefficients)
        self.probe = model.kernel_probe()
        self.loads = tuple(self._point_loads(pulled) for pulled in self.drive.pulled)
        self.drive = self.drive._replace(pulled=())
        self.contacts = make_contacts(model, self.rest, inputs, self.threads)
        self.means = tuple(make_means(self, g) for g in range(len(model.groups)))
        self.parts = tuple(
            (kernel, means, group.bodies[0], group.bodies[-1] + 1)
            for kernel, means, group in zip(self.groups, self.means, model.groups, strict=True)
        )
        self.ghosts = self._make_ghosts()
        self.bundle = self._make_run()
        self.moves = self._make_moves()
        self.reactions = self._make_reactions()
        self.histories = make_histories(model, self.groups, self._rows_of_motion())
        self.start = self._make_start()
        self.kept_because = self._why_kept()
        self.reversible = not self.kept_because

    def _point_loads(self, pulled: Pulled) -> PointLoads:
        """Return the points that forces pull, each of which rides on a particle."""
        model, X = self.model, self.rest.x
        particle, offset, _ = model.force_points()
        rest, n = riding_at(X, particle) + offset, -(-len(particle) // PADDING) * PADDING
        points = riding_points(self.rest.patches, X, particle, rest, model.dx)
        q, push = (pack(np.zeros((rows * model.dim, n)), model.real) for rows in (2, 1))
        return PointLoads(points, pulled, particle, rest, q, push)

    def _make_ghosts(self) -> tuple[Ghost, ...]:
        """Return the ghost penalty, with the mean shear modulus of each body, or none."""
        modulus = mean_modulus(self.model, self.inputs)
        if not modulus.any():
            return ()
        self.runs = self.rest.runs(self.inputs.fields.volume, self.model.dx)
        return (kernel_ghost(self.runs, self._ghost_scale(modulus), self.model.real),)

    def _ghost_scale(self, modulus: Array) -> Array:
        """Return the scale of each run of the ghost penalty (R,) for the mean shear modulus of each body (B,)."""
        body = self.rest.patches.body_of_nodes()[self.runs.lightest]
        return GAMMA * self.model.dx ** (self.model.dim - 2) * modulus[body] * self.runs.fill

    def _make_run(self) -> NodeRun:
        model, patches, real = self.model, self.rest.patches, self.model.real
        m, kappa = self.inputs.fields.mass, np.exp(-self.inputs.fields.damping * model.dt)
        mass, kept = self.rest.to_nodes(np.stack([m, kappa * m], axis=1)).T
        bits = self.rest.held(model).bits * (mass > 0)
        nodes = Nodes(mass.astype(real), kept.astype(real), bits, np.flatnonzero(mass > 0))
        threads, n_nodes = self.threads, patches.n_nodes
        rates = any(needs_rate(type(term)) for group in self.groups for term in group.terms)
        rates = rates or any(needs_velocity(type(force)) for force in self.drive.forces)
        setting = NodeSetting((0,) * model.dim, patches.strides, model.dx, model.dt, model.substeps, (0,) * rates)
        tiles = Tiles(*(aligned((threads, rows * TILE, 4), real) for rows in (1, 3, 1, 3, 3)))
        push = model.no_push(self.drive.steady)
        q = replace(State.at_rest(self.inputs.state.x), history=self.inputs.state.history).pack(model.layout, real)
        force, outside = aligned((n_nodes, 4), real), aligned((n_nodes, 4), real)
        return NodeRun(
            setting, nodes, self.rest.stencils, patches.units, self.rest.rest, self.fields, push, force, outside, q,
            tiles, no_watch(), np.full(1, -1), self.team.arrivals,
        )  # fmt: skip

    def _make_moves(self) -> tuple[Moves, ...]:
        """Return the nodes of boundaries that move, or none."""
        model, patches = self.model, self.rest.patches
        self.shares = [progress(model, over) for _, over in parts_of(model)]
        if not self.shares:
            return ()
        nodes, plane, arm = moving_nodes(model, self.bundle.nodes.bits, patches.positions(model.dx))
        pose = poses(model, self.inputs.moves, self.shares)
        glue(model, pose, self.inputs.waypoints)
        return (Moves(nodes, plane, arm, pose),)

    def _make_reactions(self) -> tuple[Reactions, ...]:
        """Return what boundaries do to the bodies, or none if it is not recorded."""
        patches = self.rest.patches
        first = self._rows_before_impulses()
        X, bits = patches.positions(self.model.dx), self.bundle.nodes.bits
        return make_reactions(self.model, bits, X, self.contacts.obstacles, first)

    def _make_start(self) -> Array:
        """Return the state at the start: no displacement, the particles' momentum on the nodes, and relaxed springs.

        It is (2, M + E + H, 4); M nodes are followed by E rows of springs and impulses, and H rows of histories.
        """
        state, m, dim = self.inputs.state, self.inputs.fields.mass, self.model.dim
        n_nodes, start = self.rest.patches.n_nodes, self._still_state()
        momentum = self.rest.to_nodes(m[:, None] * state.v, m[:, None, None] * state.C * self.model.dx)
        active = self.bundle.nodes.active
        v = np.zeros_like(momentum)
        v[active] = momentum[active] / self.bundle.nodes.mass[active, None]
        self.free_start = v.copy()
        for n in active[self.bundle.nodes.bits[active] != 0]:
            v[n] = project_all(self.conditions, n, int(self.bundle.nodes.bits[n]), tuple(v[n]))
        start[1, :n_nodes, :dim] = v
        for rigid in rigid_of(self.contacts):
            put_start(rigid, self.model, start)
        return start

    def _still_state(self) -> Array:
        """Return a state (2, M + E + H, 4) without displacement and motion, with the histories of bodies at rest."""
        histories = [rows_of_state(self.bundle.q, each.first) for each in self.histories]
        rows = self._rows_of_motion() + sum(each.shape[1] for each in histories)
        start = aligned((2, rows, 4), self.model.real)
        for own in histories:
            start[:, self._rows_of_motion() :] = own
        return start

    def _rows_of_motion(self) -> int:
        """Return how many rows of a state are of nodes, springs and impulses."""
        return self._rows_before_impulses() + rows_of_impulses(self.reactions)

    def _rows_before_impulses(self) -> int:
        """Return how many rows of a state are of nodes, springs and rigid bodies that move freely."""
        rows = self.rest.patches.n_nodes + -(-self.model.n_springs // 2)
        return rows + ROWS * count_free(self.model.rigid)

    def _why_kept(self) -> str:
        """Return why the state before a substep does not follow from the one after it; empty if it does."""
        if self.histories:
            return "stresses have a history"
        if count_free(self.model.rigid):
            return "a rigid body moves freely"
        if self.bundle.setting.rates:
            return "stresses or forces depend on velocities"
        if self._refresh() < 1:
            return "its damping is too strong to run backwards in this memory"
        for bits, n in zip(*np.unique(self.bundle.nodes.bits, return_index=True), strict=True):
            # several planes at a node that do not stand at right angles: the last one undoes the first
            axes = [project_all(self.conditions, n, int(bits), tuple(axis)) for axis in np.eye(self.model.dim)]
            P = np.array(axes)
            if np.abs(P @ P - P).max() > 1e-12 or np.abs(P - P.T).max() > 1e-12:
                return "planes of slip stand at acute angles"
        return ""

    def _refresh(self) -> int:
        """Return after how many substeps a reversed run starts again from a kept state; 0 if memory does not allow."""
        model, damping = self.model, float(self.inputs.fields.damping.max(initial=0.0))
        longest = model.n_steps if damping <= 0 else int(MOST_GROWTH / (damping * model.dt))
        if model.real is np.float32:
            longest = min(longest, FLOAT32_STEPS)
        count = max(1, min(SNAPSHOTS, model.memory_budget) // self.start.nbytes - 2)
        every = -(-model.n_steps // count)
        return 0 if every > longest else max(1, min(max(every, FEWEST_STEPS), longest, model.n_steps))

    def gradients(self, loss_bars: Callable[[Records, State], Iterable[LossBar]]) -> tuple[Records, list[BackwardRun]]:
        """Run forward once, and backward once for each of several functions; see `Rollout.gradients`."""
        if not self.reversible:
            return super().gradients(loss_bars)
        n_steps, every, self.kept_because = self.model.n_steps, self._refresh(), ""
        current, snapshots = self.start[None].copy(), []
        clear_slid(self.contacts)
        for begin in range(0, n_steps, every):
            snapshots.append(current[0].copy())
            if not self._advance_freely(begin, min(begin + every, n_steps), current):
                self.kept_because = "contact has friction or a dashpot"
                return super().gradients(loss_bars)
        self.plan = self._backwards_plan()
        self.final = current[0]
        records = self.read_records()
        final = self.unpack(self.final, self.model.n_controls)
        sweeps = [self._reversed_backward(bar) for bar in loss_bars(records, final)]
        for sweep in sweeps:
            state = self.final[None].copy()
            for k in reversed(range(len(snapshots))):
                sweep.run(k * every, min((k + 1) * every, n_steps), state)
                state = snapshots[k][None].copy()
        self.growth_at = max((sweep.growth for sweep in sweeps), default=(0.0, -1))[1]
        return records, sweeps

    def _advance_freely(self, begin: int, end: int, states: Array) -> bool:
        """Run substeps begin .. end, but stop soon after contact that cannot be reversed; return whether it ended."""
        steps = LOOK_FOR_CONTACT if any(self.contacts) else max(1, end - begin)
        for at in range(begin, end, steps):
            self.advance(at, min(at + steps, end), states, keep=False)
            if has_slid(self.contacts):
                return False
        return True

    def _backwards_plan(self) -> Plan:
        every = self._refresh()
        snapshots = -(-self.model.n_steps // every)
        return Plan(every, snapshots, snapshots, snapshots + 1, 1.0, backwards=True)

    def expected_plan(self) -> Plan:
        """Return how a gradient would keep its states; raise RunError if it does not fit the memory."""
        return self._backwards_plan() if self.reversible and not self.kept_because else super().expected_plan()

    def backward(self, loss_bar: LossBar) -> BackwardRun:
        """Return the backward run, from kept states, of the cotangents of the results."""
        return ReferenceBackward(self, loss_bar, reverses=False)

    def _reversed_backward(self, loss_bar: LossBar) -> BackwardRun:
        """Return the backward run that finds each state from the next."""
        return ReferenceBackward(self, loss_bar, reverses=True)

    def read_records(self) -> Records:
        """Return the probe's records so far, with the reactions of the boundaries that are recorded."""
        held, rigid = reactions_by_name(self.reactions, self.model), rigid_of(self.contacts)
        return replace(super().read_records(), held=held, rigid=poses_by_name(rigid, self.model))

    def held_at(self, control: int) -> dict[str, Array]:
        """Return force and moment of every recorded boundary in the control step that ended at `control`, by name."""
        return reactions_at(self.reactions, self.model, control)

    def rigid_at(self, control: int) -> dict[str, Array]:
        """Return what is seen of every rigid body at a control step, by name; see `Records.rigid`."""
        return poses_by_name(rigid_of(self.contacts), self.model, control)

    def _record_start(self) -> None:
        crew = Crew(0, 1)
        note(self.bundle, self.start[0], self.start[1], self.probe, self.records[0], crew)
        for contact in self.contacts.obstacles:
            note_all_poses(contact, self.bundle, self.start[0], self.start[1], 0, crew)

    def unpack(self, q: Array, control: int) -> State:
        """Return the state of the particles for a state of the nodes (2, M + E + H, 4)."""
        put_histories(self.histories, self.bundle.q, q)
        look(self.bundle, q[0], q[1], Crew(0, 1))
        return State.unpack(self.bundle.q, self.model.layout, self.memory[control])

    def _advance(self, begin: int, end: int, states: Array, keep: bool) -> None:
        self.bundle.stray[0] = -1
        colours = self.rest.patches.colours

        def body(thread: int, to: int = end, n: int = self.threads) -> int:
            reached: int = advance(
                self.parts, self.histories, self.conditions, self.loads, self.ghosts, self.moves, self.reactions,
                self.contacts, self.drive, self.bundle, colours, states, begin, to, keep, self.probe, self.records,
                Crew(thread, n),
            )  # fmt: skip
            return reached

        if self.threads > 1:
            body(0, begin, 1)  # compile on one thread, so that the others do not wait for it at a barrier
        reached = self.team.run(body)
        if self.bundle.stray[0] >= 0:
            self._fail(reached, states[reached - begin if keep else 0])
        for rigid in rigid_of(self.contacts):
            if rigid.met[0] >= 0:
                raise meeting_error(rigid, self.model)

    def remarks(self) -> list[str]:
        """Return sentences about the most deformed particles, and a substep that is too long for them."""
        return list(remarks_on(self))

    def _fail(self, step: int, q: Array) -> None:
        look(self.bundle, q[0], q[1], Crew(0, 1))
        x = State.unpack(self.bundle.q, self.model.layout, np.zeros(0)).x
        lost = np.flatnonzero(~np.isfinite(x).all(axis=1))
        worst = most_stretched(self)  # what blows up takes the whole body with it within a few substeps
        particle = worst if worst in lost else int(lost[0])
        advice = f"the simulation blew up: {why_it_failed(self)}"
        self._report(particle, step, "its position is not finite", self._with_limit(advice, particle))

"""Equilibrium of a model in the reference frame, and its adjoint: one more linear solve, and no time.

The net force on the free nodes vanishes, f(u, theta) = 0, so K du = (df/dtheta) dtheta with K = -df/du, which is
symmetric for every law with an energy. For a loss L(u) the adjoint solves K lambda = dL/du, and then

    dL/dtheta = lambda . df/dtheta,

which is the adjoint of one substep's forces at lambda. Velocities are zero, so viscosity and damping have no part.

A loss of the reactions depends on f itself, by a cotangent g of the forces on held nodes (reactions.py). Then

    K lambda = P (dL/du + (df/du)^T g),    dL/dtheta = (lambda + g) . df/dtheta,

where P projects on the free directions, and (df/du)^T g is a product with the matrix of all nodes.

Forces without a potential, such as tendons that rub, make K unsymmetric. Then the steps are found by GMRES, and the
adjoint's linear system has the transposed matrix, K^T lambda = dL/du.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from cqrun.engine.model import Inputs, LossBar, Model
from cqrun.engine.probe import record
from cqrun.engine.reference.backward import ReferenceBackward
from cqrun.engine.reference.look import look
from cqrun.engine.reference.moves import poses, poses_vjp
from cqrun.engine.reference.rollout import ReferenceRollout
from cqrun.engine.reference.step import begin_control
from cqrun.engine.setting import Crew
from cqrun.engine.statics.holding import Planes, loose_bodies
from cqrun.engine.statics.krylov import Solution, conjugate_gradients, minimal_residuals
from cqrun.engine.statics.newton import MOST_PRODUCTS, Rest, find_rest
from cqrun.engine.statics.passes import find_bars, find_change, find_change_vjp, find_net, find_slopes
from cqrun.engine.statics.precondition import REFRESH, Preconditioner
from cqrun.engine.statics.reactions import Holder, holders, resultant, resultant_vjp
from cqrun.engine.statics.tangent import rows_of
from cqrun.engine.statics.touching import contact_names, make_contact_at_rest
from cqrun.engine.statics.volumes import MeanVolumes
from cqrun.forces.force import is_unsymmetric
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import aligned
from cqrun.plugin.contract import Array
from cqrun.state import State

TINY_STRAIN = 1e-4
"""Strain whose forces are the measure of the residual of a body without loads."""


@dataclass(frozen=True)
class AdjointSolve:
    """How well the linear system of an adjoint was solved."""

    products: int
    converged: bool


class Equilibrium:
    """Find where one model rests under the loads and activations of one control step.

    Args:
        threads: number of threads at most. The results do not depend on it.
        control: the control step whose activations act.
        slow: whether the coarse space is made at once, because equilibria like this one needed it.

    Attributes:
        symmetric: whether all forces have a potential, so that the stiffness matrix is symmetric.
    """

    def __init__(self, model: Model, inputs: Inputs, *, threads: int = 1, control: int = 0, slow: bool = False) -> None:
        fading = {name for group in model.groups for name in group.fading}
        if lasting := [field.name for field in model.layout.history if field.name not in fading]:
            raise ValueError(f"a material with a history ({', '.join(lasting)}) has no equilibrium of its own")
        alone = replace(model, surface=None, obstacles=(), rigid=(), reactions=(), static=True)
        self.rollout = ReferenceRollout(alone, inputs, threads=threads, adjoint=True)
        self.contact = make_contact_at_rest(model, inputs, self.rollout.rest)
        self.control, self.run = control, self.rollout.bundle
        self.symmetric = not any(is_unsymmetric(type(force)) for force in self.rollout.drive.forces)
        self.solver = conjugate_gradients if self.symmetric else minimal_residuals
        self.dim, self.n_nodes = model.dim, len(self.run.nodes.mass)
        patches, real = self.rollout.rest.patches, model.real
        self.colours = patches.colours
        width = lane_width(real)
        self.A = aligned((patches.layout.n // width, rows_of(self.dim), width), real)
        self.still = aligned((self.n_nodes, 4), real)
        self.holding = Planes(model.conditions, model.size, self.run.nodes.bits, self._places()).holding()
        self.one = [np.ones(1) for _ in self.rollout.shares]
        self.carried = self._carried()
        self._each(lambda crew: begin_control(self.rollout.drive, self.run, self.colours, control, crew))
        self.outside = self.run.outside.copy()
        self.volumes = MeanVolumes(self.rollout) if any(self.rollout.means) else None
        self.preconditioner = Preconditioner(
            self.rollout, self.A, self.holding, self.volumes, control, slow=slow, contact=self.contact
        )

    @property
    def size(self) -> int:
        """Its size in memory, roughly [bytes]."""
        return 4 * self.A.nbytes + self.preconditioner.size

    # --- the system (`newton.System`) -----------------------------------------------------------------------------

    def net(self, u: Array) -> Array:
        """Return the net force on every node (M, 4) [N], zero where nodes are held."""
        r = self.rollout
        self._each(
            lambda crew: find_net(
                r.parts, r.loads, r.ghosts, r.drive, self.run, self.colours, u, self.still, self.control, crew
            )
        )
        if self.contact is not None:
            self.run.force[:, :3] += self.contact.forces(u)
        return self.holding.freed(self.run.force + self.outside)

    def linearise(self, u: Array) -> None:
        """Prepare the tangent and its preconditioner at a displacement."""
        self._each(
            lambda crew: find_slopes(
                self.rollout.parts, self.rollout.loads, self.run, self.A, u, self.still, self.colours, crew
            )
        )
        if self.volumes is not None:
            self.volumes.prepare()
        if self.contact is not None:
            self.contact.linearise(u)
        self.preconditioner.prepare()

    def product(self, p: Array) -> Array:
        """Return the stiffness matrix times a displacement (M, 4)."""
        self.preconditioner.since += 1
        return self.holding.freed(-self._change(p))

    def product_vjp(self, p: Array) -> Array:
        """Return the transposed stiffness matrix times a displacement (M, 4)."""
        self.preconditioner.since += 1
        return self.holding.freed(-self._change_vjp(p))

    def precondition(self, r: Array) -> Array:
        """Return the forces (M, 4) times something like the inverse of the stiffness matrix."""
        return self.preconditioner.solve(r)

    # --- what a user asks ---------------------------------------------------------------------------------------------

    def solve(self, u: Array | None = None, *, tolerance: float = 1e-8, judge: bool = False) -> Rest:
        """Return where the model rests, from a first guess of the displacements (M, 4), or from the rest shape.

        Args:
            tolerance: net force divided by the loads.
            judge: whether the smallest eigenvalue at the answer is found in any case, not only if it costs little.
        """
        start = aligned((self.n_nodes, 4), self.run.force.dtype)
        if u is not None:
            start[...] = u
        change = self.carried - (start - self.holding.freed(start))
        if change.any():
            start += change + self._follow(start, change)
        load = self.load()
        if change.any():
            load = max(load, float(np.linalg.norm(self.net(start))))
        rest = find_rest(self, start, load, tolerance, self.solver)
        return self._judged(rest) if rest.converged and (judge or self.preconditioner.coarse is not None) else rest

    def smallest_eigenvalue(self, u: Array) -> float:
        """Return the smallest eigenvalue of the stiffness at a displacement, relative to its blocks; NaN if unknown.

        It is that of the coarse space, and so an upper bound; it is negative where the equilibrium is not stable.
        """
        self.linearise(u)
        return self.preconditioner.smallest()

    def first_step(self, u: Array) -> Array:
        """Return the change to the equilibrium from a displacement (M, 4) near it, to first order."""
        change = self.carried - (u - self.holding.freed(u))
        net = self.net(u)
        self.linearise(u)
        pull = net - self.product(change)
        return np.asarray(change + self.solver(self.product, pull, self.precondition, 1e-2, MOST_PRODUCTS).x)

    def load(self) -> float:
        """Return the size of all loads [N]: external forces, and those of active stresses and cables at rest.

        A body without any load has its residual measured by the forces of a strain of TINY_STRAIN. (Boundaries that
        carry their nodes load a body, too: `solve` adds what the first guess lacks.)
        """
        inner = self.net(np.zeros_like(self.outside)) - self.holding.freed(self.outside)
        load = float(np.sqrt((self.holding.freed(self.outside) ** 2).sum() + (inner**2).sum()))
        if load > 0.0:
            return load
        self.linearise(np.zeros_like(self.outside))
        stiffness = 1.0 / np.linalg.norm(self.preconditioner.inverse, axis=(1, 2))
        return float(TINY_STRAIN * self.rollout.model.dx * np.linalg.norm(stiffness))

    def state(self, u: Array) -> State:
        """Return the state of the particles at a displacement, at rest."""
        return self.rollout.unpack(self._at(u), 0)

    def _at(self, u: Array) -> Array:
        """Return the state of the nodes (2, M + H, 4) at rest at a displacement; histories have faded."""
        state = np.zeros_like(self.rollout.start)
        state[0, : self.n_nodes] = u
        return state

    def record(self, u: Array) -> Array:
        """Return the probe's sums (rows, K) at a displacement."""
        look(self.run, u, self.still, Crew(0, 1))
        out = np.zeros_like(self.rollout.records[0])
        record(self.rollout.probe, self.run.q, out)
        return out

    def reactions(self, u: Array) -> Array:
        """Return the forces (M, D) [N] with which boundaries hold the nodes."""
        self.net(u)
        force = self.run.force + self.outside
        return np.asarray((self.holding.freed(force) - force)[:, : self.dim])

    def held_by(self, u: Array) -> dict[str, tuple[Array, Array]]:
        """Return the force (D,) [N] and the moment (1,) or (3,) [N m] of every boundary, by its name.

        Boundaries divide the reaction of a node that several hold (holding.py). A moment is about `Model.center`, with
        the arms of the nodes where they are now.
        """
        force = self.reactions(u)
        found = {name: resultant(holder, u, force) for name, holder in self.holders().items()}
        return found if self.contact is None else found | self.contact.held_by(u)

    def held_names(self) -> tuple[str, ...]:
        """Return the names of all that have forces and moments in `held_by`."""
        return (*self.holders(), *contact_names(self.contact))

    def holders(self) -> dict[str, Holder]:
        """Return the nodes that every boundary holds, by its name."""
        return holders(self.rollout.model, self.run.nodes.bits, self._places())

    def gradient(self, u: Array, *, record_bar: Array | None = None, state_bar: State | None = None,
                 held_bar: Mapping[str, tuple[Array, Array]] | None = None, tolerance: float = 1e-10,
                 ) -> tuple[Inputs, AdjointSolve]:  # fmt: skip
        """Return the cotangent of the inputs at an equilibrium u, from those of what is known of it.

        Args:
            record_bar: of its record (rows, K).
            state_bar: of its state.
            held_bar: of forces and moments in `held_by`, by boundary.
            tolerance: relative residual of the adjoint's linear system.
        """
        self.rollout.final = self._at(u)
        back = ReferenceBackward(self.rollout, LossBar(final=state_bar), reverses=False)
        if record_bar is not None:
            back._add_record(back.q_bar, record_bar)
        u_bar, f_bar = back.q_bar[0].copy(), np.zeros_like(u)
        if held_bar:
            f_bar = self._add_held_bar(u, held_bar, u_bar)
        bar, solve = self.gradient_of_nodes(u, u_bar, f_bar, tolerance=tolerance, held_bar=held_bar or {})
        bar.state.x += back.moving_bar()
        return bar, solve

    def gradient_of_nodes(
        self, u: Array, u_bar: Array, f_bar: Array | None = None, *, tolerance: float = 1e-10,
        held_bar: Mapping[str, tuple[Array, Array]] = MappingProxyType({}),
    ) -> tuple[Inputs, AdjointSolve]:  # fmt: skip
        """Return the cotangent of the inputs at an equilibrium, from those of displacements and net forces (M, 4).

        `held_bar` has those of what bodies touch, whose part of `u_bar` is there already.
        """
        self.rollout.final = self._at(u)
        back = ReferenceBackward(self.rollout, LossBar(), reverses=False)
        loss_bar = u_bar.copy()
        self.linearise(u)
        if f_bar is not None:
            loss_bar += self._change_vjp(f_bar)
        loss_bar = self.holding.freed(loss_bar)
        found = self._solve(loss_bar, tolerance)
        adjoint = found.x if f_bar is None else found.x + f_bar
        r = self.rollout
        self._each(
            lambda crew: find_bars(
                back.parts, r.loads, r.ghosts, r.drive, back.stresses, back.drive_bar.levels, self.run, back.bundle,
                self.colours, u, self.still, adjoint, self.control, crew,
            )
        )  # fmt: skip
        bar = back.inputs_bar()
        if self.contact is not None:
            self.contact.add_bars(u, adjoint, held_bar, bar)
            back.bundle.sums[::2, :3] += self.contact.change(adjoint)
        there = (u_bar + back.bundle.sums[::2])[:, : self.dim]  # of held nodes, directly and through forces
        for moves in r.moves:
            there_bar = there[moves.nodes]
            pose_bar = np.zeros((len(self.one), 1, self.dim + self.dim**2))
            rows = np.concatenate(
                [there_bar, np.einsum("hi,hj->hij", there_bar, moves.arm).reshape(len(there_bar), -1)], axis=1
            )
            np.add.at(pose_bar[:, 0], moves.plane, rows)
            bar.moves[...] = poses_vjp(r.model, r.inputs.moves, self.one, pose_bar)
        return bar, AdjointSolve(found.iterations, found.converged)

    def _add_held_bar(self, u: Array, held_bar: Mapping[str, tuple[Array, Array]], u_bar: Array) -> Array:
        """Add to the cotangent of u, and return that of the net forces (M, 4), from those of `held_by`."""
        force, f_bar = self.reactions(u), np.zeros_like(u)
        for name, holder in self.holders().items():
            if name in held_bar:
                r_bar, a_bar = resultant_vjp(holder, u, force, *held_bar[name])
                f_bar[holder.nodes, : self.dim] -= r_bar
                u_bar[holder.nodes, : self.dim] += a_bar
        if self.contact is not None:
            u_bar[:, :3] += self.contact.u_bar(u, held_bar)
        return np.asarray(f_bar - self.holding.freed(f_bar))

    def loose_bodies(self) -> dict[str, int]:
        """Return the bodies that nothing holds, by name: in how many ways each can move as a rigid body."""
        names, patches = self.rollout.model.body_names, self.rollout.rest.patches
        return loose_bodies(names, patches.body_of_nodes(), self._places(), self.holding)

    # --- inside -------------------------------------------------------------------------------------------------------

    def _each(self, body: Callable[[Crew], None]) -> None:
        """Run a pass on all threads."""
        n = self.rollout.threads
        self.rollout.team.run(lambda thread: body(Crew(thread, n)))

    def _solve(self, b: Array, tolerance: float) -> Solution:
        """Return the adjoint's solution at the state of `linearise`; a long search gets a coarse space."""
        most = MOST_PRODUCTS if self.preconditioner.fresh else REFRESH
        first = self.solver(self.product_vjp, b, self.precondition, tolerance, most)
        if first.converged or first.negative:
            return first
        self.preconditioner.add_coarse()
        left = b - self.product_vjp(first.x)
        relative = tolerance * float(np.linalg.norm(b) / np.linalg.norm(left))
        second = self.solver(self.product_vjp, left, self.precondition, relative, 10 * MOST_PRODUCTS)
        return second._replace(x=first.x + second.x, iterations=first.iterations + second.iterations)

    def _judged(self, rest: Rest) -> Rest:
        """Return a rest with the smallest eigenvalue there, and whether one is negative.

        The coarse space may see none where the fine one does. Then the eigenvalue is not known. That of an unsymmetric
        matrix is not sought.
        """
        if not self.symmetric:
            return rest
        smallest = self.smallest_eigenvalue(rest.u)
        if np.isnan(smallest):
            return replace(rest, smallest=smallest if rest.negative else rest.smallest)
        if smallest <= 0.0 or not rest.negative:
            return replace(rest, negative=smallest <= 0.0, smallest=smallest)
        some = np.random.default_rng(0).normal(size=rest.u.shape) * (self.run.nodes.mass > 0)[:, None]
        some[:, self.dim :] = 0.0
        found = conjugate_gradients(self.product, self.holding.freed(some), self.precondition, 1e-6, MOST_PRODUCTS)
        return replace(rest, negative=found.negative, smallest=float("nan") if found.negative else smallest)

    def _carried(self) -> Array:
        """Return where boundaries carry their nodes: the displacement of held nodes (M, 4), zero elsewhere."""
        out = np.zeros((self.n_nodes, 4))
        for moves in self.rollout.moves:
            pose = poses(self.rollout.model, self.rollout.inputs.moves, self.one)[moves.plane, 0]
            R = pose[:, self.dim :].reshape(-1, self.dim, self.dim)
            out[moves.nodes, : self.dim] = pose[:, : self.dim] + np.einsum("hij,hj->hi", R, moves.arm)
        return out

    def _follow(self, u: Array, change: Array) -> Array:
        """Return how the free nodes follow a change of the held ones, to first order: a good guess for the search."""
        self.linearise(u)
        pull = -self.product(change)
        return self.solver(self.product, pull, self.precondition, 1e-2, MOST_PRODUCTS).x

    def _change(self, p: Array) -> Array:
        """Return the change of the forces on all nodes (M, 4) with a displacement p, at the state of `linearise`.

        The array is that of the next pass, too.
        """
        return self._changed_by(find_change, p)

    def _change_vjp(self, p: Array) -> Array:
        """Return the product of p with the transposed matrix of `_change`."""
        return self._changed_by(find_change if self.symmetric else find_change_vjp, p)

    def _changed_by(self, find: Callable[..., None], p: Array) -> Array:
        r = self.rollout
        self._each(lambda crew: find(r.loads, r.ghosts, r.drive, self.run, self.A, self.colours, p, self.control, crew))
        if self.volumes is not None:
            self.run.force[:, : self.dim] -= self.volumes.product(p[:, : self.dim])
        if self.contact is not None:
            self.run.force[:, :3] += self.contact.change(p)
        return self.run.force

    def _places(self) -> Array:
        """Return where the nodes are at rest (M, D) [m]."""
        return self.rollout.rest.patches.positions(self.rollout.model.dx)

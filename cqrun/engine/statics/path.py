"""A path of equilibria: each point starts from the last one, and has a gradient of its own.

A path that is judged notices where Newton's method lands on another branch, as a body that snaps through does: see
`RestPath._watched`. Where Newton's method does not reach a point, the way to it is halved, at most `HALVINGS` times:
all inputs change in proportion. The first point is reached from the rest shape without loads. A path with slightly
other inputs can start each point from the equilibrium of the same point of an earlier path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from cqrun.engine.model import Inputs, Model, Records
from cqrun.engine.reference.rest import nodes_before
from cqrun.engine.rigid_model import OFFSET
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.newton import Rest
from cqrun.engine.statics.precondition import REFRESH
from cqrun.errors import StopAsked
from cqrun.plugin.contract import Array

LOOSER = 100.0
"""Relative residual of an adjoint's linear system, divided by that of an equilibrium. The relative error of a gradient
is about a fiftieth of that residual (docs/decisions/012-rest.md). Reactions need the residual of the equilibrium
itself: their cotangent is large beside what comes of it."""

KEPT = 2**28
"""Bytes of equilibria that wait for their gradient; it is cheaper with their preconditioner."""

HALVINGS = 6
"""Most halvings of the way to a point."""

UNEXPECTED = 3.0
"""A displacement that is larger than expected from either end by this factor is not smooth; where a body buckles, and
displacement grows with the root of the load, the factor is 2."""

BISECTIONS = 6
"""How often the part of the way with the larger change is halved then."""

STILL = 1e-6
"""A body whose particles move less than this from one point to the next stays where it is [cells]."""

JUMP = 0.1
"""Part of the whole change that the last of these intervals has at least if displacement jumps there."""


@dataclass(frozen=True)
class Point:
    """A point of a path: its rest, and how it was reached.

    Attributes:
        rest: the displacement and how it was found; of the last attempt, if no equilibrium was found.
        reached: part of the way from the last point that was covered; 1 if an equilibrium was found.
        halvings: how often the way was halved.
        products: products with the stiffness matrix on the whole way.
        jump: largest displacement of a particle in a jump on the way [m]; NaN if there is none.
        jump_at: part of the way at which it jumps.
    """

    rest: Rest
    reached: float
    halvings: int
    products: int
    jump: float = float("nan")
    jump_at: float = float("nan")


class Found(NamedTuple):
    """An equilibrium: its inputs, the displacement (M, 4) [m], and whether its path needed the coarse space."""

    inputs: Inputs
    u: Array
    slow: bool


@dataclass
class RestRecords(Records):
    """What is known of the rest shape and of every point of a path, or the cotangent of it.

    `held` has the force [N] and the moment [N m] of every boundary (P + 1, D + 1) or (P + 1, 6); zero in row 0.

    Attributes:
        found: the equilibria of all points, from which a path with other inputs can start.
    """

    found: list[Found] = field(default_factory=list)

    @classmethod
    def joined(cls, records: Records, held: dict[str, Array]) -> RestRecords:
        """Return records with the forces and moments of boundaries."""
        return cls(*records, history=records.history, held=held)

    def zeros_like(self) -> RestRecords:
        """Return zero records of the same shapes."""
        zero = super().zeros_like()
        return RestRecords.joined(zero, zero.held)


class RestPath:
    """The equilibria of one model for several inputs, one after the other.

    Args:
        inputs: inputs of each point; only their last control step acts.
        threads: number of threads at most. The results do not depend on it.
        tolerance: net force divided by the loads at which a point counts as found.
        apart: whether the points have nothing to do with each other: then a point starts from the rest shape if the net
            force is smaller there than at the last point. Otherwise a path stays on its branch.
        judge: whether the smallest eigenvalue at every point is found in any case.
        near: equilibria of all points for other inputs, from which each point starts. Where that fails, it starts as
            without them.

    Attributes:
        points: the points found so far.
        slow: whether the points need the coarse space, as the first ones have shown.
        loose: the bodies that nothing holds, by name: in how many ways each can move.
        rows: the probe's sums (rows, K) at the rest shape and at every point.
    """

    def __init__(
        self, model: Model, inputs: Sequence[Inputs], *, threads: int = 1, tolerance: float = 1e-8, apart: bool = False,
        judge: bool = False, near: Sequence[Found] = (),
    ) -> None:  # fmt: skip
        self.model = replace(model, n_controls=1, substeps=1)
        self.inputs = [replace(each, activation=each.activation[-1:]) for each in inputs]
        self.threads, self.tolerance, self.apart = threads, tolerance, apart
        self.judge, self.points = judge, list[Point]()
        self.numbers: Array | None = None  # of the nodes in `near`, if the bodies have other shapes there
        self.near, self.slow = near, any(each.slow for each in near)
        self.kept: dict[int, Equilibrium] = {}
        unloaded = self.equilibrium(_unloaded(self.inputs[0]))
        self.loose = unloaded.loose_bodies()
        self.rest_shape = np.zeros_like(unloaded.still)
        self.rows = [unloaded.record(self.rest_shape)]
        size = model.dim + (1 if model.dim == 2 else 3)
        self.held = {name: [np.zeros(size)] for name in unloaded.held_names()}
        self.start = unloaded

    def equilibrium(self, inputs: Inputs) -> Equilibrium:
        """Return the equilibrium of the model for some inputs."""
        return Equilibrium(self.model, inputs, threads=self.threads, slow=self.slow)

    def run(
        self,
        observe: Callable[[int, Equilibrium, Point], None] | None = None,
        should_stop: Callable[[], bool] | None = None,
        known: Callable[[int], Point | None] | None = None,
        keep: bool = False,
    ) -> RestRecords:
        """Find all points; stop after one that has no equilibrium, or when asked.

        Args:
            observe: called with (number, equilibrium, point) of every point.
            should_stop: called before every point; if it returns True, StopAsked is raised.
            known: returns a point that was found before, by its number, or None.
            keep: whether `gradients` follows.
        """
        before, u = _unloaded(self.inputs[0]), self.rest_shape
        for number, inputs in enumerate(self.inputs):
            if should_stop is not None and should_stop():
                raise StopAsked
            here = self.equilibrium(inputs)
            point = known(number) if known is not None else None
            point = self._find(number, here, before, u) if point is None else point
            self.slow |= point.products > REFRESH
            self.points.append(point)
            if observe is not None:
                observe(number, here, point)
            if not point.rest.converged:
                break
            self.rows.append(here.record(point.rest.u))
            for name, parts in here.held_by(point.rest.u).items():
                self.held[name].append(np.concatenate(parts))
            if keep and here.size + sum(each.size for each in self.kept.values()) <= KEPT:
                self.kept[number] = here
            before, u = inputs, point.rest.u
        records = Records.from_rows(np.array(self.rows), here.rollout.model.layout.table)
        joined = RestRecords.joined(records, {name: np.array(rows) for name, rows in self.held.items()})
        pairs = zip(self.points, self.inputs, strict=False)
        joined.found = [Found(inputs, point.rest.u, self.slow) for point, inputs in pairs]
        return joined

    def _find(self, number: int, here: Equilibrium, before: Inputs, u: Array) -> Point:
        """Return a point from that of `near`, from the last one, which is given, or from the rest shape."""
        inputs = self.inputs[number]
        if self.near:
            rest = here.solve(self._near(number, here), tolerance=self.tolerance, judge=self.judge)
            if rest.converged:
                return Point(rest, 1.0, 0, rest.products)
        if self.apart and _net(here, self.rest_shape) < _net(here, u):
            before, u = _unloaded(self.inputs[0]), self.rest_shape
        point = self._reach(here, before, inputs, u)
        return self._watched(here, before, u, point) if self.judge and point.rest.converged else point

    def _watched(self, here: Equilibrium, before: Inputs, u: Array, point: Point) -> Point:
        """Return a point with the jump of displacement on the way from the last one, if there is any.

        On one branch a small step moves the body as far as the linear equations at either end say. If it moves much
        farther, or if Newton's method had trouble, the way is bisected towards the larger change. A jump keeps its size
        then, and is farther than expected; a smooth change is neither.
        """
        end = point.rest.u
        moved = _size(here, end - u)
        if not float(_motion(here, end - u).max()) > STILL * self.model.dx:
            return point
        ends = self.equilibrium(before), here
        if not point.rest.troubled and not point.halvings and not _unexpected(*ends, u, end):
            return point
        low, high, u_high = 0.0, 1.0, end
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            rest = self.equilibrium(between(before, here.rollout.inputs, middle)).solve(u, tolerance=self.tolerance)
            if not rest.converged:
                high = middle
            elif _size(here, rest.u - u) > _size(here, u_high - rest.u):
                high, u_high = middle, rest.u
            else:
                low, u = middle, rest.u
        last = [self.equilibrium(between(before, here.rollout.inputs, part)) for part in (low, high)]
        if _size(here, u_high - u) <= JUMP * moved or not _unexpected(last[0], last[1], u, u_high):
            return point
        return replace(point, jump=float(_motion(here, u_high - u).max()), jump_at=high)

    def _near(self, number: int, here: Equilibrium) -> Array:
        """Return the displacement of a point of `near`, on the nodes of this path: its bodies may have other shapes."""
        found, patches = self.near[number], here.rollout.rest.patches
        if np.array_equal(found.inputs.state.x, here.rollout.rest.x):
            return found.u
        if self.numbers is None:
            self.numbers = nodes_before(self.model, found.inputs.state.x, patches)
        return found.u[self.numbers]

    def _reach(self, here: Equilibrium, before: Inputs, inputs: Inputs, u: Array) -> Point:
        """Return a point reached from the last one."""
        rest = here.solve(u, tolerance=self.tolerance, judge=self.judge)
        products, covered, halvings, step = rest.products, 0.0, 0, 0.5
        while not rest.converged and halvings < HALVINGS:
            halvings += 1
            while covered < 1.0:
                to = min(1.0, covered + step)
                at = here if to == 1.0 else self.equilibrium(between(before, inputs, to))
                trial = at.solve(u, tolerance=self.tolerance, judge=self.judge)
                products += trial.products
                if not trial.converged:
                    rest = trial if to == 1.0 else rest
                    step *= 0.5
                    break
                covered, u, rest = to, trial.u, trial if to == 1.0 else rest
        return Point(rest, 1.0 if rest.converged else covered, halvings, products)

    def gradients(self, records_bar: Records) -> list[Inputs]:
        """Return the cotangent of every point's inputs from that of the records (row 0, the rest shape, has none)."""
        table, dim = self.start.rollout.model.layout.table, self.model.dim
        bars = records_bar.to_rows(table)
        held = records_bar.held
        out = []
        for k, (point, inputs) in enumerate(zip(self.points, self.inputs, strict=True), start=1):
            of_point = {name: (rows[k, :dim], rows[k, dim:]) for name, rows in held.items() if rows[k].any()}
            here = self.kept.pop(k - 1, None) or self.equilibrium(inputs)
            tolerance = self.tolerance if of_point else LOOSER * self.tolerance
            bar, _ = here.gradient(point.rest.u, record_bar=bars[k], held_bar=of_point, tolerance=tolerance)
            out.append(bar)
        return out


MIXED = ("activation", "strength", "rest", "friction", "weights", "moves", "rigid", "waypoints")
"""The inputs that change on the way, beside fields and terms."""


def _motion(here: Equilibrium, u: Array) -> Array:
    """Return how far each particle moves with a displacement of the nodes (N,) [m].

    Nodes that hardly touch the body may move much farther.
    """
    return np.asarray(np.linalg.norm(here.state(u).x - here.rollout.inputs.state.x, axis=1))


def _unexpected(first: Equilibrium, last: Equilibrium, u: Array, end: Array) -> bool:
    """Return whether two equilibria are farther apart than the linear equations at one of them say."""
    ways = last.first_step(u), first.first_step(end)
    return _size(last, end - u) > UNEXPECTED * min(_size(last, way) for way in ways)


def _size(here: Equilibrium, u: Array) -> float:
    """Return the size of a displacement: the root of the sum of squares over all particles [m]."""
    return float(np.linalg.norm(_motion(here, u)))


def _net(here: Equilibrium, u: Array) -> float:
    """Return the size of the net force at a displacement [N]; infinite where it is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        size = float(np.linalg.norm(here.net(u)))
    return size if np.isfinite(size) else np.inf


def between(a: Inputs, b: Inputs, s: float) -> Inputs:
    """Return inputs on the straight way from a (s = 0) to b (s = 1)."""

    def mixed(x: Array, y: Array) -> Array:
        return np.asarray(x + s * (y - x))

    fields = replace(
        b.fields,
        **{name: mixed(getattr(a.fields, name), getattr(b.fields, name)) for name in ("mass", "volume", "force")},
    )
    terms = [[mixed(*pair) for pair in zip(*groups, strict=True)] for groups in zip(a.terms, b.terms, strict=True)]
    changed = {name: mixed(getattr(a, name), getattr(b, name)) for name in MIXED}
    return replace(b, fields=fields, terms=terms, **changed)


def _unloaded(inputs: Inputs) -> Inputs:
    """Return the inputs without loads and actuation, and with rigid bodies where their shapes are."""
    rigid = inputs.rigid.copy()
    rigid[:, OFFSET] = 0.0
    return replace(
        inputs, fields=replace(inputs.fields, force=inputs.fields.force * 0.0), strength=inputs.strength * 0.0,
        moves=inputs.moves * 0.0, rigid=rigid, waypoints=inputs.waypoints * 0.0,
    )  # fmt: skip

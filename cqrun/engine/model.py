"""Model and inputs: what a rollout is built from. Nothing here changes during a rollout.

`Model` is frozen: the grid, the bodies' layout, the terms of each body's stress, boundaries, actuators, time.
`Inputs` are the numbers that gradients reach, in user order and float64; a cotangent is another `Inputs`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from cqrun.actuators.push import make_kernel, pushes, starts_of
from cqrun.boundaries.condition import BoundaryCondition, NodeNormals, Normal
from cqrun.engine.probe import make_probe
from cqrun.engine.setting import Drive, Probe, Stresses, grid_shape, node_positions
from cqrun.numerics.packed import pack
from cqrun.plugin.contract import Array
from cqrun.state import Layout, ParticleFields, State, rows_of


@dataclass(frozen=True)
class GroupModel:
    """Consecutive bodies with the same terms of stress.

    `kernel_terms` make each term's kernel view from its packed parameters theta; `active` are the kinds of active
    stress among its actuators, terms like the others but for the activations that fill them.
    """

    bodies: tuple[int, ...]
    kernel_terms: tuple[Callable[[Array], Any], ...]
    active: tuple[type, ...] = ()


@dataclass(frozen=True)
class ActuatorModel:
    """What has one activation: a part of an actuator.

    `kernel` is the class of its kind, `constants` what `Actuator.constants` says; particles are in user order, those
    of a cable in the order of its route.
    """

    name: str
    kernel: type
    particles: Array
    constants: Array


@dataclass(frozen=True)
class ConditionModel:
    """One plane of a boundary condition: which nodes it holds, and where it comes from."""

    name: str
    spec: BoundaryCondition
    normal: Normal
    nodes: Array

    def kernel(self, coefficient: float) -> Any:
        """Return the kernels' view."""
        own = self.normal
        normal = own if isinstance(own, tuple) else NodeNormals(own, (0,) * own.shape[1])
        return self.spec.kernel_condition(normal)._replace(coefficient=float(coefficient))


@dataclass(frozen=True)
class Model:
    """Everything fixed about a rollout."""

    size: Array  # of the world (D,) [m]
    dx: float
    dt: float
    substeps: int  # in a control step
    n_controls: int
    body_names: tuple[str, ...]
    layout: Layout
    groups: tuple[GroupModel, ...]
    conditions: tuple[ConditionModel, ...] = ()
    actuators: tuple[ActuatorModel, ...] = ()
    probe: sparse.csr_array | None = None  # (K, N) weighted sums to record
    real: Any = np.float64
    memory_budget: int = 2 * 2**30  # bytes for states kept for gradients
    spare: list[Array] = field(default_factory=list, repr=False, compare=False)  # memory for them (`checkpoint.py`)

    @property
    def dim(self) -> int:
        """Dimension of the world."""
        return len(self.size)

    @property
    def n_steps(self) -> int:
        """Number of substeps."""
        return self.substeps * self.n_controls

    @property
    def grid_shape(self) -> tuple[int, ...]:
        """Number of nodes along each axis."""
        return grid_shape(self.size, self.dx)

    def group_slices(self) -> list[slice]:
        """Return each group's slice of the user arrays."""
        bodies = self.layout.slices()
        return [slice(bodies[g.bodies[0]].start, bodies[g.bodies[-1]].stop) for g in self.groups]

    def held(self) -> Array:
        """Return the bits of the conditions that hold each node (nodes,)."""
        held = np.zeros(int(np.prod(self.grid_shape)), np.int64)
        for k, condition in enumerate(self.conditions):
            held |= condition.nodes.astype(np.int64) << k
        return held

    def kernel_probe(self) -> Probe:
        """Return the probe over kernel columns."""
        matrix = sparse.csr_array((0, self.layout.n_particles)) if self.probe is None else self.probe
        return make_probe(matrix, self.layout.columns(), rows_of(self.dim)[-1])

    def kinds(self) -> tuple[list[type], list[type]]:
        """Return the kinds of active stress, and of force, of the actuators."""
        kinds = list(dict.fromkeys(a.kernel for a in self.actuators))
        return [k for k in kinds if not pushes(k)], [k for k in kinds if pushes(k)]

    @property
    def weight_slices(self) -> list[slice]:
        """Each actuator's slice of the weights of particles."""
        ends = np.cumsum([0, *(len(a.particles) for a in self.actuators)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    def kernel_drive(self, inputs: Inputs) -> Drive:
        """Return what the actuators act through."""
        weights, rest = inputs.weights, inputs.rest
        columns, (stresses, forces) = self.layout.columns(), self.kinds()
        pieces, shares = [columns[a.particles] for a in self.actuators], self.weight_slices
        if not len(weights):
            weights = np.ones(shares[-1].stop if shares else 0)

        def of(kind: type) -> tuple[Array, list[Array], list[Array]]:
            own = [k for k, a in enumerate(self.actuators) if a.kernel is kind]
            return np.array(own, np.int64), [pieces[k] for k in own], [self.actuators[k].constants for k in own]

        def stress(kind: type) -> Stresses:
            own, held, directions = of(kind)
            theta = pack(np.zeros((len(directions[0]), self.layout.n)), self.real)
            weight = np.concatenate([weights[shares[k]] for k in own])
            return Stresses(theta, *starts_of(held), own, np.array(directions, float), weight)

        n_pushed = self.layout.n if forces else 0
        return Drive(
            np.array(inputs.activation, np.float64, order="C"),
            np.array(inputs.strength, np.float64),
            np.array(rest, np.float64) if len(rest) else np.zeros(len(self.actuators)),
            tuple(stress(kind) for kind in stresses),
            tuple(make_kernel(kind, *of(kind)) for kind in forces),
            pack(np.zeros((self.dim, n_pushed)), self.real),
        )


@dataclass
class Inputs:
    """What a rollout depends on; as a cotangent, the derivative of the loss by each of them.

    `terms[g][k]` (rows, N_g) are the parameters of term k of group g, `activation` (T, A) has one row a control step,
    `strength` (A,) one number an actuator, in its own unit, `coefficients` one a plane of a boundary condition,
    `weights` one a particle of each actuator, one actuator after another; all 1 if empty. Forces have no weights.
    `rest` (A,) is the length at rest of each actuator [m], which cables have; all 0 if empty.
    """

    state: State
    fields: ParticleFields
    terms: list[list[Array]]
    activation: Array
    strength: Array
    coefficients: Array = field(default_factory=lambda: np.zeros(0))
    weights: Array = field(default_factory=lambda: np.zeros(0))
    rest: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def zeros_like(cls, other: Inputs) -> Inputs:
        """Return a zero cotangent."""
        s, n, dim = other.state, *other.state.x.shape
        return cls(
            State(*(np.zeros_like(a) for a in (s.x, s.v, s.C, s.F)), np.zeros_like(s.memory)),
            ParticleFields.zeros(n, dim),
            [[np.zeros_like(theta) for theta in group] for group in other.terms],
            np.zeros_like(other.activation),
            np.zeros_like(other.strength),
            np.zeros_like(other.coefficients),
            np.zeros_like(other.weights),
            np.zeros_like(other.rest),
        )


class Records(NamedTuple):
    """What a rollout writes down at control steps 0 .. T of K weighted means over particles; or the cotangent of that.

    Attributes:
        x, v: (T + 1, K, D) position [m], velocity [m/s].
        C, F: (T + 1, K, D, D) velocity gradient [1/s], deformation gradient [1].
    """

    x: Array
    v: Array
    C: Array
    F: Array

    @classmethod
    def from_rows(cls, rows: Array, dim: int) -> Records:
        """Return the records in kernel rows (T + 1, rows, K)."""
        a = np.ascontiguousarray(rows.transpose(0, 2, 1))
        shape = (*a.shape[:2], dim, dim)
        d = dim
        return cls(
            a[..., :d],
            a[..., d : 2 * d],
            a[..., 2 * d : 2 * d + d * d].reshape(shape),
            a[..., 2 * d + d * d :].reshape(shape),
        )

    def to_rows(self) -> Array:
        """Return kernel rows (T + 1, rows, K)."""
        flat = (*self.x.shape[:2], self.x.shape[2] ** 2)  # not -1: there may be no rows
        parts = [self.x, self.v, self.C.reshape(flat), self.F.reshape(flat)]
        out = np.empty((len(self.x), sum(part.shape[2] for part in parts), self.x.shape[1]), self.x.dtype)
        return np.concatenate([part.transpose(0, 2, 1) for part in parts], axis=1, out=out)

    @classmethod
    def zeros(cls, n_controls: int, k: int, dim: int) -> Records:
        """Return zero records, as a cotangent to fill."""
        return cls.from_rows(np.zeros((n_controls + 1, 2 * dim + 2 * dim * dim, k)), dim)


@dataclass
class LossBar:
    """Cotangents of what a rollout gives: records, the last state, activations (T, A); None for zero."""

    records: Records | None = None
    final: State | None = None
    activation: Array | None = None


def conditions_of(name: str, spec: BoundaryCondition, size: Array, dx: float) -> list[ConditionModel]:
    """Return the planes of one boundary condition on the grid of a world."""
    size = np.asarray(size, float)
    nodes = node_positions(grid_shape(size, dx), dx)
    return [ConditionModel(name, spec, normal, inside) for inside, normal in spec.places(nodes, size)]

"""Model and inputs: what a rollout is built from. Nothing here changes during a rollout.

`Model` is frozen: the grid, the bodies' layout, the terms of each body's stress, boundaries, actuators, time.
`Inputs` are the numbers that gradients reach, in user order and float64; a cotangent is another `Inputs`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.boundaries.condition import BoundaryCondition, NodeNormals, Normal
from cqrun.engine.probe import make_probe
from cqrun.engine.setting import Drive, Probe, Stresses, grid_shape, make_pulled, node_positions
from cqrun.forces.force import Kind, Levels, is_force, make_forces
from cqrun.forces.steady import is_steady, make_steady, starts_of
from cqrun.numerics.packed import pack
from cqrun.plugin.contract import Array
from cqrun.state import MOTION, Layout, ParticleFields, State, StateField, StateTable, state_table


@dataclass(frozen=True)
class GroupModel:
    """Consecutive bodies with the same terms of stress.

    `kernel_terms` make each term's kernel view from its packed parameters theta; `active` are the kinds of active
    stress among its actuators, terms like the others but for the activations that fill them; `history` names the fields
    of the state that belong to each of the terms, empty if no term has any.
    """

    bodies: tuple[int, ...]
    kernel_terms: tuple[Callable[[Array], Any], ...]
    active: tuple[type, ...] = ()
    history: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class ActuatorModel:
    """A part of an actuator, which has one activation, or of a force, which has none.

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
    forces: tuple[ActuatorModel, ...] = ()  # parts of forces without an activation
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
        return make_probe(matrix, self.layout.columns(), self.layout.table.n_rows)

    @property
    def parts(self) -> tuple[ActuatorModel, ...]:
        """All parts that have a strength: those of actuators, and after them those of forces without an activation."""
        return (*self.actuators, *self.forces)

    def kinds(self) -> tuple[list[type], list[type], list[type]]:
        """Return the kinds of active stress, of steady force, and of force that depends on the state."""
        kinds = list(dict.fromkeys(part.kernel for part in self.parts))
        steady, forces = [k for k in kinds if is_steady(k)], [k for k in kinds if is_force(k)]
        return [k for k in kinds if k not in steady + forces], steady, forces

    @property
    def weight_slices(self) -> list[slice]:
        """Each actuator's slice of the weights of particles."""
        ends = np.cumsum([0, *(len(a.particles) for a in self.actuators)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    def kernel_drive(self, inputs: Inputs) -> Drive:
        """Return what actuators and forces act through."""
        weights, rest, parts = inputs.weights, inputs.rest, self.parts
        columns, (stresses, steady, forces) = self.layout.columns(), self.kinds()
        pieces, shares = [columns[part.particles] for part in parts], self.weight_slices
        if not len(weights):
            weights = np.ones(shares[-1].stop if shares else 0)

        def of(kind: type) -> tuple[Array, list[Array], list[Array]]:
            mine = [k for k, part in enumerate(parts) if part.kernel is kind]
            return np.array(mine, np.int64), [pieces[k] for k in mine], [parts[k].constants for k in mine]

        def stress(kind: type) -> Stresses:
            mine, held, directions = of(kind)
            theta = pack(np.zeros((len(directions[0]), self.layout.n)), self.real)
            weight = np.concatenate([weights[shares[k]] for k in mine])
            return Stresses(theta, *starts_of(held), mine, np.array(directions, float), weight)

        always_on = np.ones((len(inputs.activation), len(self.forces)))
        levels = Levels(
            np.concatenate([np.asarray(inputs.activation, np.float64), always_on], axis=1),
            np.array(inputs.strength, np.float64),
            np.array(rest, np.float64) if len(rest) else np.zeros(len(parts)),
        )
        kernels, all_shares = make_forces([Kind(kind, *of(kind)) for kind in forces], self.dim)
        return Drive(
            levels, tuple(stress(kind) for kind in stresses), tuple(make_steady(kind, *of(kind)) for kind in steady),
            kernels, make_pulled(all_shares),
        )  # fmt: skip

    def no_push(self, kinds: Sequence[Any]) -> Array:
        """Return forces on particles of zero, packed; without columns where there is no kind of force."""
        return pack(np.zeros((self.dim, self.layout.n if kinds else 0)), self.real)


@dataclass
class Inputs:
    """What a rollout depends on; as a cotangent, the derivative of the loss by each of them.

    `terms[g][k]` (rows, N_g) are the parameters of term k of group g, `activation` (T, A) has one row a control step,
    `strength` one number a part of `Model.parts`, in its own unit, `coefficients` one a plane of a boundary condition,
    `weights` one a particle of each actuator, one actuator after another; all 1 if empty. Forces have no weights.
    `rest` is the length at rest of each of these parts [m], which cables and springs have; all 0 if empty.
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
            s.zeros_like(),
            ParticleFields.zeros(n, dim),
            [[np.zeros_like(theta) for theta in group] for group in other.terms],
            np.zeros_like(other.activation),
            np.zeros_like(other.strength),
            np.zeros_like(other.coefficients),
            np.zeros_like(other.weights),
            np.zeros_like(other.rest),
        )


@dataclass
class Records:
    """What a rollout writes down at control steps 0 .. T of K weighted means over particles; or the cotangent of that.

    Iterating over it gives x, v, C and F.

    Attributes:
        x, v: (T + 1, K, D) position [m], velocity [m/s].
        C, F: (T + 1, K, D, D) velocity gradient [1/s], deformation gradient [1].
        history: (T + 1, K, ...) of material terms that have one, by name.
    """

    x: Array
    v: Array
    C: Array
    F: Array
    history: dict[str, Array] = field(default_factory=dict)

    def __iter__(self) -> Iterator[Array]:
        """Iterate over x, v, C and F."""
        return iter((self.x, self.v, self.C, self.F))

    @classmethod
    def from_rows(cls, rows: Array, table: StateTable) -> Records:
        """Return the records in kernel rows (T + 1, rows, K)."""
        a = np.ascontiguousarray(rows.transpose(0, 2, 1))
        arrays = {f.name: a[..., table.rows[f.name]].reshape(*a.shape[:2], *f.shape) for f in table.fields}
        motion = {name: arrays.pop(name) for name in MOTION}
        return cls(**motion, history=arrays)

    def zeros_like(self) -> Records:
        """Return zero records of the same shapes."""
        x, v, C, F = (np.zeros_like(a) for a in self)
        return Records(x, v, C, F, {name: np.zeros_like(a) for name, a in self.history.items()})

    def to_rows(self, table: StateTable) -> Array:
        """Return kernel rows (T + 1, rows, K); histories that it lacks count as zero."""
        out = np.zeros((len(self.x), table.n_rows, self.x.shape[1]), self.x.dtype)
        for name, array in ({name: getattr(self, name) for name in MOTION} | self.history).items():
            rows = table.rows[name]
            out[:, rows] = array.reshape(*array.shape[:2], rows.stop - rows.start).transpose(0, 2, 1)
        return out

    @classmethod
    def zeros(cls, n_controls: int, k: int, dim: int, history: Sequence[StateField] = ()) -> Records:
        """Return zero records, as a cotangent to fill."""
        table = state_table(dim, tuple(history))
        return cls.from_rows(np.zeros((n_controls + 1, table.n_rows, k)), table)


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

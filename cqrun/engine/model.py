"""A rollout's model and inputs, which do not change in the rollout, and its records.

`Model` is frozen: grid, layout of the bodies, terms of their stress, boundaries, actuators, time.
`Inputs` are the numbers that gradients reach, in user order and float64; their cotangent is another `Inputs`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.boundaries.condition import BoundaryCondition, NodeNormals, Normal
from cqrun.engine.lattice import Lattice
from cqrun.engine.probe import make_probe
from cqrun.engine.rigid_model import NUMBERS, ROWS, RigidModel, count_free
from cqrun.engine.setting import Drive, Probe, Stresses, grid_shape, node_positions
from cqrun.engine.surface import MeetingModel, ObstacleModel, SurfaceModel, count_springs
from cqrun.forces.force import Kind, Levels, is_force, make_forces
from cqrun.forces.pulled import make_pulled
from cqrun.forces.steady import is_steady, make_steady, starts_of
from cqrun.numerics.packed import pack
from cqrun.plugin.contract import Array
from cqrun.state import MOTION, Layout, ParticleFields, State, StateField, StateTable, state_table


@dataclass(frozen=True)
class GroupModel:
    """Consecutive bodies with the same terms of stress.

    `kernel_terms` make each term's kernel view from its packed parameters theta. `active` are the kinds of active
    stress, terms whose parameters the activations fill. `history` has each term's fields of the state, or is empty, and
    `fading` those fields that fade, so that bodies come to rest.
    `shear` and `wave` return each term's part of the shear modulus and of the stiffness of a pressure wave (n,) [Pa]
    from theta (rows, n), or are empty.
    """

    bodies: tuple[int, ...]
    kernel_terms: tuple[Callable[[Array], Any], ...]
    active: tuple[type, ...] = ()
    history: tuple[tuple[str, ...], ...] = ()
    shear: tuple[Callable[[Array], Array], ...] = ()
    wave: tuple[Callable[[Array], Array], ...] = ()
    fading: tuple[str, ...] = ()


@dataclass(frozen=True)
class ActuatorModel:
    """A part of an actuator, which has one activation, or of a force, which has none.

    `kernel` is the class of its kind, `constants` are those of `Actuator.constants`. Particles are in user order; those
    of a cable are in the order of its route. In the reference frame a force acts on points that ride on the particles,
    at `offsets` (n, D) from them at rest [m]; without offsets these are the particles themselves. A point whose
    particle is -1 is fixed in the world, and its offset is its place.
    """

    name: str
    kernel: type
    particles: Array
    constants: Array
    offsets: Array | None = None

    @property
    def carriers(self) -> Array:
        """The particles that its points ride on, without points that are fixed in the world."""
        return self.particles[self.particles >= 0]

    def at_rest(self, x: Array) -> Array:
        """Return its points at rest (n, D) [m] where particles rest at x (N, D)."""
        return x[self.particles] if self.offsets is None else riding_at(x, self.particles) + self.offsets


def riding_at(x: Array, particle: Array) -> Array:
    """Return the particles' positions (n, D) that points count from; 0 for those fixed in the world (particle -1)."""
    return np.where(particle[:, None] < 0, 0.0, x[particle])


@dataclass(frozen=True)
class ConditionModel:
    """One plane of a boundary condition, and the nodes of the world's grid (bool) that it applies to."""

    name: str
    spec: BoundaryCondition
    normal: Normal
    nodes: Array

    def kernel(self, coefficient: float) -> Any:
        """Return the kernels' view."""
        n = self.normal
        view = self.spec.kernel_condition(n if isinstance(n, tuple) else NodeNormals(n, (0,) * n.shape[1]))
        return view._replace(coefficient=float(coefficient))


@dataclass(frozen=True)
class Model:
    """The parts of a rollout that are fixed."""

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
    memory_budget: int = 2 * 2**30  # for the states that gradients keep [bytes]
    forces: tuple[ActuatorModel, ...] = ()  # parts of forces without an activation
    frame: str = "updated"  # of the engine (`frames.py`)
    n_nodes: int = 0  # of all bodies, in the reference frame
    averaged: bool = False  # whether volumes are means over the corners of cells, in the reference frame
    offset: Array | None = None  # of each body's grid from that of the world (B, D) [m], in the reference frame
    lattice: Lattice | None = None  # on which particles hang together, in the reference frame
    settled: bool = False  # whether the motion starts at equilibrium
    static: bool = False  # whether equilibria are sought, and no motion
    surface: SurfaceModel | None = None  # of the bodies, in the reference frame
    obstacles: tuple[ObstacleModel, ...] = ()  # in the reference frame
    meeting: MeetingModel | None = None  # of bodies with each other, in the reference frame
    rigid: tuple[RigidModel, ...] = ()  # in the reference frame
    reactions: tuple[str, ...] = ()  # boundaries whose forces and moments are recorded, in the reference frame
    centers: Mapping[str, Array] = field(default_factory=dict)  # by boundary: about which moments and rotations are [m]
    regions: Mapping[tuple[str, str], Array] = field(
        default_factory=dict, repr=False, compare=False
    )  # of messages: the
    # particles of each group, by body and name
    spare: list[Array] = field(default_factory=list, repr=False, compare=False)  # free memory for states
    at_rest: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)  # what a frame knows of the rest

    @property
    def dim(self) -> int:
        """Dimension of the world."""
        return len(self.size)

    @property
    def state_bytes(self) -> int:
        """Bytes of one kept state: of the particles, or in the reference frame of nodes, springs and histories.

        The histories of a sorted layout have a little more padding, and the impulses of recorded reactions, which only
        nodes have that slip or are carried, are not counted.
        """
        rows = self.n_nodes + -(-self.n_springs // 2) + ROWS * count_free(self.rigid)
        remembered = sum(field.size for field in self.layout.history) * self.layout.n
        numbers = 8 * rows + remembered if self.frame == "reference" else self.layout.table.n_rows * self.layout.n
        return int(numbers * np.dtype(self.real).itemsize)

    @property
    def n_coefficients(self) -> int:
        """Number of coefficients of friction: of the planes of boundaries, and of bodies that meet."""
        return len(self.conditions) + (self.meeting is not None)

    @property
    def n_springs(self) -> int:
        """Number of tangential springs of contact, which are part of the state."""
        return sum(count_springs(self.surface, self.obstacles, self.meeting, self.rigid))

    @property
    def first_skin_spring(self) -> int:
        """Number of the first spring on the skins of rigid bodies."""
        return count_springs(self.surface, self.obstacles, self.meeting, self.rigid)[0]

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

    def center(self, boundary: str, X: Array) -> Array:
        """Return the point of a boundary's moment and rotation (D,) [m]; if none is given, the mean of its nodes X."""
        of_spec = (getattr(plane.spec, "center", None) for plane in self.conditions if plane.name == boundary)
        given = self.centers.get(boundary, next(of_spec, None))
        return X.mean(axis=0) if given is None else np.array(given, float)

    def condition_bits(self) -> Array:
        """Return for each node the bits of the conditions that apply to it (nodes,)."""
        bits = np.zeros(int(np.prod(self.grid_shape)), np.int64)
        for k, condition in enumerate(self.conditions):
            bits |= condition.nodes.astype(np.int64) << k
        return bits

    def kernel_probe(self) -> Probe:
        """Return the probe over kernel columns."""
        matrix = sparse.csr_array((0, self.layout.n_particles)) if self.probe is None else self.probe
        return make_probe(matrix, self.layout.columns(), self.layout.table.n_rows)

    @property
    def parts(self) -> tuple[ActuatorModel, ...]:
        """All parts with a strength: those of actuators, then those of forces without an activation."""
        return (*self.actuators, *self.forces)

    def kinds(self) -> tuple[list[type], list[type], list[type]]:
        """Return the kinds of active stress, of steady forces, and of forces that depend on the state."""
        kinds = list(dict.fromkeys(part.kernel for part in self.parts))
        steady, forces = [k for k in kinds if is_steady(k)], [k for k in kinds if is_force(k)]
        return [k for k in kinds if k not in steady + forces], steady, forces

    @property
    def weight_slices(self) -> list[slice]:
        """Each actuator's slice of `Inputs.weights`."""
        ends = np.cumsum([0, *(len(a.particles) for a in self.actuators)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    def force_points(self) -> tuple[Array, Array, dict[int, Array]]:
        """Return the points of all forces on points: their particles (P,), and their offsets from them (P, D) [m].

        A point that is fixed in the world has the particle -1, and its place as offset.

        Then, by the number of a part, which of the points are its own.
        """
        chosen = [k for k, part in enumerate(self.parts) if is_force(part.kernel)]
        rows = [np.zeros((0, 1 + self.dim))]
        for part in (self.parts[k] for k in chosen):
            offsets = np.zeros((len(part.particles), self.dim)) if part.offsets is None else part.offsets
            rows.append(np.column_stack([part.particles, offsets]))
        points, number = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
        pieces = np.split(number.reshape(-1), np.cumsum([len(own) for own in rows[1:]]))
        return points[:, 0].astype(np.int64), points[:, 1:], dict(zip(chosen, pieces, strict=False))

    def _columns(self) -> list[Array]:
        """Return the columns of each part's particles; for forces of the reference frame, the numbers of points."""
        columns = self.layout.columns()
        pieces = [columns[part.particles] for part in self.parts]
        if self.frame == "reference":
            for k, points in self.force_points()[2].items():
                pieces[k] = points
        return pieces

    def kernel_drive(self, inputs: Inputs) -> Drive:
        """Return the kernels' view of actuators and forces."""
        weights, rest, parts = inputs.weights, inputs.rest, self.parts
        (stresses, steady, forces), pieces, shares = self.kinds(), self._columns(), self.weight_slices
        if not len(weights):
            weights = np.ones(shares[-1].stop if shares else 0)

        def of(kind: type) -> tuple[Array, list[Array], list[Array]]:
            chosen = [k for k, part in enumerate(parts) if part.kernel is kind]
            return np.array(chosen, np.int64), [pieces[k] for k in chosen], [parts[k].constants for k in chosen]

        def stress(kind: type) -> Stresses:
            chosen, particles, directions = of(kind)
            theta = pack(np.zeros((len(directions[0]), self.layout.n)), self.real)
            weight = np.concatenate([weights[shares[k]] for k in chosen])
            return Stresses(theta, *starts_of(particles), chosen, np.array(directions, float), weight)

        always_on = np.ones((len(inputs.activation), len(self.forces)))
        activation = np.concatenate([np.asarray(inputs.activation, np.float64), always_on], axis=1)
        rest = np.array(rest, np.float64) if len(rest) else np.zeros(len(parts))
        friction = np.array(inputs.friction, np.float64) if len(inputs.friction) else np.zeros(len(parts))
        levels = Levels(activation, np.array(inputs.strength, np.float64), rest, friction)
        kernels, all_shares = make_forces([Kind(kind, *of(kind)) for kind in forces], self.dim)
        return Drive(
            levels, tuple(stress(kind) for kind in stresses), tuple(make_steady(kind, *of(kind)) for kind in steady),
            kernels, (make_pulled(all_shares),) if kernels else (),
        )  # fmt: skip

    def no_push(self, kinds: Sequence[Any]) -> Array:
        """Return zero forces on particles, packed; without columns if there is no kind of force."""
        return pack(np.zeros((self.dim, self.layout.n if kinds else 0)), self.real)


@dataclass
class Inputs:
    """The numbers that a rollout depends on; as a cotangent, the derivative of the loss by each of them."""

    state: State
    fields: ParticleFields
    terms: list[list[Array]]  # [g][k]: parameters (rows, N_g) of term k of group g
    activation: Array  # (T, A) one row per control step
    strength: Array  # of each of `Model.parts`, in its own unit
    coefficients: Array = field(default_factory=lambda: np.zeros(0))  # of planes of boundaries, then between bodies
    weights: Array = field(default_factory=lambda: np.zeros(0))  # of each particle of each actuator; all 1 if empty
    rest: Array = field(default_factory=lambda: np.zeros(0))  # length at rest of each part [m]; all 0 if empty
    moves: Array = field(default_factory=lambda: np.zeros(0))  # (planes, D + 1 or 6) displacement and rotation
    surface: Array = field(default_factory=lambda: np.zeros(0))  # points at rest (S, D) [m]; the model's if empty
    friction: Array = field(default_factory=lambda: np.zeros(0))  # coefficient of each part [1]; all 0 if empty
    rigid: Array = field(default_factory=lambda: np.zeros((0, NUMBERS)))  # of rigid bodies (`rigid_model.py`)
    waypoints: Array = field(default_factory=lambda: np.zeros((0, 6)))  # of their paths: displacement, rotation vector
    shaped: bool = False  # whether gradients by the rest positions are wanted, in the reference frame

    @classmethod
    def zeros_like(cls, other: Inputs) -> Inputs:
        """Return a zero cotangent."""
        terms = [[np.zeros_like(theta) for theta in group] for group in other.terms]
        numbers = (
            other.activation,
            other.strength,
            other.coefficients,
            other.weights,
            other.rest,
            other.moves,
            other.surface,
            other.friction,
            other.rigid,
            other.waypoints,
        )
        fields = ParticleFields.zeros(*other.state.x.shape)
        return cls(other.state.zeros_like(), fields, terms, *map(np.zeros_like, numbers))


@dataclass
class Records:
    """K weighted means over particles, recorded at control steps 0 .. T, or the cotangent of these records.

    `held` has the force [N] and the moment [N m] (T + 1, D + 1) or (T + 1, 6) with which each recorded boundary acts on
    the bodies, by its name (2D: [N/m], [N]): means over the control step that ends there, zero in row 0. `rigid` has
    displacement, rotation vector (2D: angle), velocity and angular velocity (T + 1, 6 or 12) of each rigid body.
    """

    x: Array  # (T + 1, K, D) position [m]
    v: Array  # (T + 1, K, D) velocity [m/s]
    C: Array  # (T + 1, K, D, D) velocity gradient [1/s]
    F: Array  # (T + 1, K, D, D) deformation gradient [1]
    history: dict[str, Array] = field(default_factory=dict)  # (T + 1, K, ...) of material terms that have one, by name
    held: dict[str, Array] = field(default_factory=dict)
    rigid: dict[str, Array] = field(default_factory=dict)

    def __iter__(self) -> Iterator[Array]:
        """Iterate over x, v, C and F."""
        return iter((self.x, self.v, self.C, self.F))

    @classmethod
    def from_rows(cls, rows: Array, table: StateTable) -> Records:
        """Return the records of kernel rows (T + 1, rows, K)."""
        a = np.ascontiguousarray(rows.transpose(0, 2, 1))
        arrays = {f.name: a[..., table.rows[f.name]].reshape(*a.shape[:2], *f.shape) for f in table.fields}
        motion = {name: arrays.pop(name) for name in MOTION}
        return cls(**motion, history=arrays)

    def zeros_like(self) -> Records:
        """Return zero records of the same shapes."""
        x, v, C, F = (np.zeros_like(a) for a in self)
        more = (self.history, self.held, self.rigid)
        history, held, rigid = ({name: np.zeros_like(a) for name, a in of.items()} for of in more)
        return Records(x, v, C, F, history, held, rigid)

    def add(self, other: Records) -> None:
        """Add other records to these."""
        for own, more in zip(self, other, strict=True):
            own += more
        for name, more in other.history.items():
            self.history[name] += more
        for name, more in other.held.items():
            self.held[name] += more
        for name, more in other.rigid.items():
            self.rigid[name] += more

    def add_by_name(self, more: Mapping[str, Mapping[str, Array]]) -> None:
        """Add cotangents of `held` and `rigid`, each by the names of boundaries and rigid bodies."""
        for kind, arrays in more.items():
            for name, array in arrays.items():
                getattr(self, kind)[name] += array

    def to_rows(self, table: StateTable) -> Array:
        """Return kernel rows (T + 1, rows, K); missing histories count as zero."""
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
    """Cotangents of a rollout's results: records, final state, activations (T, A); None for zero."""

    records: Records | None = None
    final: State | None = None
    activation: Array | None = None


def conditions_of(name: str, spec: BoundaryCondition, size: Array, dx: float) -> list[ConditionModel]:
    """Return the planes of one boundary condition on the grid of a world."""
    size = np.asarray(size, float)
    nodes = node_positions(grid_shape(size, dx), dx)
    return [ConditionModel(name, spec, normal, inside) for inside, normal in spec.places(nodes, size)]

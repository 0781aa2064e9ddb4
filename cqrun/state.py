"""State: the arrays that change, and the legend of symbols.

    x      position                          (N, D)     [m]
    v      velocity                          (N, D)     [m/s]
    C      affine velocity matrix (APIC)     (N, D, D)  [1/s]
    F      deformation gradient              (N, D, D)  [1]
    J      det F;  tau Kirchhoff stress, P first Piola-Kirchhoff, sigma Cauchy     [Pa]
    mass, vol0                               (N,)       [kg], [m^D] (2D: per unit depth)
    E nu mu lam   elastic constants;  eta zeta   shear and bulk viscosity          [Pa], [Pa s]
    grid_m grid_mv grid_v   mass, momentum, velocity of a node;  dx dt   spacing, substep
    W S    spline weights and slopes;  f   position in its stencil, in cells
    *_bar  cotangent: derivative of the loss by *;   *_vjp   adjoint of *

Kernels store the state as one table `q` (rows, n) with a column for each particle. `StateTable` names its rows: x, v,
C, F, and then the histories of material terms that have one (`materials/term.py`), each row-major. Code that packs,
unpacks, checkpoints, records, differentiates or writes the state gets row numbers only from that table.

q is packed lane by lane (`packed.py`), so the particles of a lane are adjacent in memory and a checkpoint is one copy.
Bodies follow each other. Each is padded to whole lanes with massless copies of its last particle, which move with it
and so never leave the grid. `memory` is one flat float64 vector for the memories of controllers, actuators, observers
and accumulators; it is saved, replayed and differentiated like x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from math import prod
from typing import NamedTuple

import numpy as np

from cqrun.numerics.packed import pack, unpack
from cqrun.plugin.contract import Array

PADDING = 16
"""The length of every body is padded to a multiple of this: whole lanes for any precision and processor."""


MASS, VOLUME, DECAY, FORCE = 0, 1, 2, 3
"""Rows of the kernels' particle fields (3 + D, n): mass, rest volume, damping factor per substep, external force."""


class StateField(NamedTuple):
    """A field of the state: some numbers of each particle that change.

    Attributes:
        name: name in `State`, in records and in files.
        shape: shape of one particle's numbers; () for one number.
        initial: values at rest, row-major.
        unit: unit of the numbers.
        description: meaning of the numbers.
    """

    name: str
    shape: tuple[int, ...]
    initial: tuple[float, ...]
    unit: str = "1"
    description: str = ""

    @property
    def size(self) -> int:
        """The number of entries for each particle."""
        return prod(self.shape)

    def at_rest(self, n: int) -> Array:
        """Return the initial values for n particles (n, *shape)."""
        return np.tile(np.array(self.initial, float), n).reshape(n, *self.shape)


@dataclass(frozen=True)
class StateTable:
    """The fields of the state, in the order of their rows in q."""

    fields: tuple[StateField, ...]

    @cached_property
    def rows(self) -> dict[str, slice]:
        """The rows of each field in q, by name."""
        ends = np.cumsum([0, *(field.size for field in self.fields)])
        return {field.name: slice(int(a), int(b)) for field, (a, b) in zip(self.fields, pairwise(ends), strict=True)}

    @property
    def n_rows(self) -> int:
        """The number of rows of q."""
        return sum(field.size for field in self.fields)

    @property
    def history(self) -> tuple[StateField, ...]:
        """The fields that material terms add."""
        return self.fields[len(MOTION) :]


MOTION = ("x", "v", "C", "F")
"""The fields of every state, in order; x comes first, so a particle's position is in the first rows of q."""


@lru_cache
def state_table(dim: int, history: tuple[StateField, ...] = ()) -> StateTable:
    """Return the table of a state in `dim` dimensions, with the histories of material terms.

    Raises:
        ValueError: two fields have the same name.
    """
    zero, vector, matrix = (0.0,), (dim,), (dim, dim)
    identity = tuple(float(i == j) for i in range(dim) for j in range(dim))
    motion = (
        StateField("x", vector, zero * dim, "m", "position"),
        StateField("v", vector, zero * dim, "m/s", "velocity"),
        StateField("C", matrix, zero * dim**2, "1/s", "affine velocity matrix (APIC)"),
        StateField("F", matrix, identity, "1", "deformation gradient"),
    )
    names = [field.name for field in (*motion, *history)]
    if len(set(names)) < len(names):
        raise ValueError(f"two fields of the state have the same name: {names}")
    return StateTable((*motion, *history))


X = state_table(2).rows["x"].start
"""First row of the position in the state, in 2D and in 3D."""


@dataclass(frozen=True)
class Layout:
    """Positions of each body's particles: in user arrays (N), and in the padded arrays of kernels (n).

    `history` are the fields that material terms add to the state.
    """

    dim: int
    counts: tuple[int, ...]
    history: tuple[StateField, ...] = ()

    @property
    def table(self) -> StateTable:
        """The fields of the state."""
        return state_table(self.dim, self.history)

    @property
    def n_particles(self) -> int:
        """Number of particles N."""
        return sum(self.counts)

    @property
    def padded(self) -> tuple[int, ...]:
        """Padded length of each body."""
        return tuple(-(-count // PADDING) * PADDING for count in self.counts)

    @property
    def n(self) -> int:
        """Number of kernel columns."""
        return sum(self.padded)

    def slices(self) -> list[slice]:
        """Return each body's slice of the user arrays."""
        ends = np.cumsum([0, *self.counts])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def columns(self) -> Array:
        """Return the kernel column of each particle (N,)."""
        starts = np.cumsum([0, *self.padded])[:-1]
        return np.concatenate([s + np.arange(c) for s, c in zip(starts, self.counts, strict=True)])

    def sources(self) -> Array:
        """Return the particle of each kernel column (n,); a padding column copies the last particle of its body."""
        pieces = zip(self.slices(), self.counts, self.padded, strict=True)
        return np.concatenate([s.start + np.minimum(np.arange(p), c - 1) for s, c, p in pieces])

    def real(self) -> Array:
        """Return which kernel columns are particles, not padding (n,)."""
        mask = np.zeros(self.n, bool)
        mask[self.columns()] = True
        return mask


@dataclass
class State:
    """The state of all particles, in user order; its cotangent is a State too.

    `history` contains the fields of material terms by name, (N, *shape) each.
    """

    x: Array
    v: Array
    C: Array
    F: Array
    memory: Array = field(default_factory=lambda: np.zeros(0))
    history: dict[str, Array] = field(default_factory=dict)

    @classmethod
    def at_rest(cls, x: Array, history: Sequence[StateField] = ()) -> State:
        """Return undeformed particles at rest at x (N, D)."""
        n, dim = x.shape
        motion = {f.name: f.at_rest(n) for f in state_table(dim).fields} | {"x": x.copy()}
        return cls(**motion, history={f.name: f.at_rest(n) for f in history})

    @property
    def arrays(self) -> dict[str, Array]:
        """The fields by name, without the memory."""
        return {name: getattr(self, name) for name in MOTION} | self.history

    def zeros_like(self) -> State:
        """Return a zero cotangent."""
        zeros = {name: np.zeros_like(getattr(self, name)) for name in (*MOTION, "memory")}
        return State(**zeros, history={name: np.zeros_like(a) for name, a in self.history.items()})

    def __add__(self, other: State) -> State:
        """Return the sum of two cotangents; a history that only one of them has counts as zero in the other."""
        total = {name: getattr(self, name) + getattr(other, name) for name in (*MOTION, "memory")}
        both = self.history | other.history
        shared = self.history.keys() & other.history.keys()
        return State(**total, history=both | {name: self.history[name] + other.history[name] for name in shared})

    def pack(self, layout: Layout, real: type = np.float64) -> Array:
        """Return the kernels' packed q."""
        n, arrays = layout.n_particles, self.arrays
        rows = np.concatenate([arrays[f.name].reshape(n, -1) for f in layout.table.fields], axis=1)
        return pack(rows[layout.sources()].T, real)

    def pack_bar(self, layout: Layout, real: type = np.float64) -> Array:
        """Return the packed cotangent of q; missing histories count as zero."""
        missing = {f.name: np.zeros((len(self.x), *f.shape)) for f in layout.history if f.name not in self.history}
        return replace(self, history=self.history | missing).pack(layout, real)

    @classmethod
    def unpack(cls, q: Array, layout: Layout, memory: Array) -> State:
        """Return the state in the kernels' packed q, as float64."""
        table, rows = layout.table, unpack(q)[:, layout.columns()].T
        arrays = {f.name: rows[:, table.rows[f.name]].reshape(len(rows), *f.shape).copy() for f in table.fields}
        motion = {name: arrays.pop(name) for name in MOTION}
        return cls(**motion, memory=memory.copy(), history=arrays)


@dataclass
class ParticleFields:
    """Quantities of each particle that loads and densities determine; a cotangent has the same type.

    mass (N,) [kg]; volume at rest (N,) [m^D]; mass-proportional damping (N,) [1/s]; external force (N, D) [N].
    """

    mass: Array
    volume: Array
    damping: Array
    force: Array

    @classmethod
    def zeros(cls, n: int, dim: int) -> ParticleFields:
        """Return zero fields for n particles."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, dim)))

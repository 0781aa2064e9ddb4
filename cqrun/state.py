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

Kernels hold all of a particle's numbers as the rows of one table `q` (rows, n): x, v, C, F, row-major, packed
lane by lane (`packed.py`), so that a lane of neighbours lies together and a checkpoint is one copy. Bodies
follow each other, each padded to whole lanes with massless copies of its last particle, which move as it does
and never leave the grid. `memory` is one flat float64 vector that controllers, actuators, observers and
accumulators remember by; it is saved, replayed and differentiated like x.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from cqrun.numerics.packed import pack, unpack
from cqrun.plugin.contract import Array

PADDING = 16
"""Bodies are padded to whole lanes of any precision, on any processor."""


MASS, VOLUME, DECAY, FORCE = 0, 1, 2, 3
"""Rows of the kernels' particle fields (3 + D, n): mass, rest volume, damping factor a substep, external force."""


def rows_of(dim: int) -> tuple[int, int, int, int, int]:
    """Return the first rows of x, v, C, F in q, and the number of rows."""
    return 0, dim, 2 * dim, 2 * dim + dim * dim, 2 * dim + 2 * dim * dim


@dataclass(frozen=True)
class Layout:
    """Where the particles of each body lie: in user arrays (N), and padded in kernels' arrays (n)."""

    dim: int
    counts: tuple[int, ...]

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
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    def columns(self) -> Array:
        """Return the kernel column of each particle (N,)."""
        starts = np.cumsum([0, *self.padded])[:-1]
        return np.concatenate([s + np.arange(c) for s, c in zip(starts, self.counts, strict=True)])

    def sources(self) -> Array:
        """Return the particle that each kernel column copies (n,): itself, or the last of its body."""
        pieces = zip(self.slices(), self.counts, self.padded, strict=True)
        return np.concatenate([s.start + np.minimum(np.arange(p), c - 1) for s, c, p in pieces])

    def real(self) -> Array:
        """Return which kernel columns are particles, not padding (n,)."""
        mask = np.zeros(self.n, bool)
        mask[self.columns()] = True
        return mask


@dataclass
class State:
    """What moves, in user order; a cotangent is another State."""

    x: Array
    v: Array
    C: Array
    F: Array
    memory: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def at_rest(cls, x: Array) -> State:
        """Return undeformed particles at rest at x (N, D)."""
        n, dim = x.shape
        return cls(x.copy(), np.zeros((n, dim)), np.zeros((n, dim, dim)), np.tile(np.eye(dim), (n, 1, 1)))

    def pack(self, layout: Layout, real: type = np.float64) -> Array:
        """Return the kernels' packed q."""
        n = layout.n_particles
        rows = np.concatenate([a.reshape(n, -1) for a in (self.x, self.v, self.C, self.F)], axis=1)
        return pack(rows[layout.sources()].T, real)

    @classmethod
    def unpack(cls, q: Array, layout: Layout, memory: Array) -> State:
        """Return the state in the kernels' packed q, as float64."""
        d = layout.dim
        X, V, C, F, end = rows_of(d)
        rows = unpack(q)[:, layout.columns()].T
        shape = (len(rows), d, d)
        return cls(
            rows[:, X:V].copy(),
            rows[:, V:C].copy(),
            rows[:, C:F].reshape(shape).copy(),
            rows[:, F:end].reshape(shape).copy(),
            memory.copy(),
        )


@dataclass
class ParticleFields:
    """What loads and densities give each particle; a cotangent is another one.

    mass (N,) [kg], volume (N,) [m^D] at rest, damping (N,) [1/s] mass-proportional, force (N, D) [N] external.
    """

    mass: Array
    volume: Array
    damping: Array
    force: Array

    @classmethod
    def zeros(cls, n: int, dim: int) -> ParticleFields:
        """Return fields of nothing for n particles."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, dim)))

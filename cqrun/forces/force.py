"""Forces that depend on the state; they are computed in every substep.

A force consists of items, such as a cable, a spring or a face under pressure. An item pulls each of its particles with
a share. Items are independent, so threads compute them in parallel; then each particle sums its shares in a fixed
order. No two threads write the same number, and the sums do not depend on the number of threads.

Kernels get a kind of force as a `NamedTuple` of its own class, with the fields `shares`, `parts` and others. The class
selects two functions, each called for one item:

    exert(kernel, item, levels, control, q)                  writes shares.force of the item's shares
    exert_vjp(kernel, item, levels, control, q, push_bar)    writes shares.x_bar, shares.v_bar and shares.level_bar

A force without a potential has a tangent that is not symmetric, so equilibria need a third one. With a potential,
exert_vjp gives the same numbers.

    exert_jvp(kernel, item, levels, control, q, move)        writes to shares.x_bar how the shares change with `move`

The numbers of the item's part a = kernel.parts[item] are `levels.activation[control, a]` [1], `levels.strength[a]` in
the force's own unit, `levels.rest[a]` [m], and `levels.friction[a]` [1]. q, push_bar (the cotangent of the force on
every particle) and move (the displacement of every particle) are packed (`state.py`, `packed.py`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from cqrun.errors import UsageError
from cqrun.numerics.compile import own_symbols
from cqrun.numerics.dispatch import ByClass
from cqrun.plugin.contract import Array, Plugin

Inside = Callable[[str | None, Any], Array]
"""Returns the indices of the particles in a body and a region; None stands for any."""

ACTIVATION, STRENGTH, REST, FRICTION = 0, 1, 2, 3
"""Columns of `Shares.level_bar`."""

_EXERT = ByClass("exert", "kernel, item, levels, control, q")
_EXERT_VJP = ByClass("exert_vjp", "kernel, item, levels, control, q, push_bar")
_EXERT_JVP = ByClass("exert_jvp", "kernel, item, levels, control, q, move")
exert, exert_vjp, exert_jvp = _EXERT.call, _EXERT_VJP.call, _EXERT_JVP.call

_RATES: set[type] = set()
_UNSYMMETRIC: set[type] = set()
_ITEMS: dict[type, Callable[[Array, Array], list[Array]]] = {}
_OWN: dict[type, slice] = {}


class Shares(NamedTuple):
    """The shares of force of the items of one kind, or of all kinds."""

    begin: Array  # (I + 1,) where the shares of an item begin
    columns: Array  # (S,) the particle of each share
    force: Array  # (S, D) [N]
    x_bar: Array  # (S, D) the share's part of the cotangent of its particle's position
    v_bar: Array  # (S, D) the same of the velocity
    level_bar: Array  # (I, 4) cotangents of an item's activation, strength, rest length and friction


own_symbols(Shares)


class Levels(NamedTuple):
    """Activation, strength, rest length and friction of each part of an actuator or a force; or their cotangents.

    Forces without an activation come last; their columns of `activation` are 1.
    """

    activation: Array  # (T, A) one row per control step [1]
    strength: Array  # (A,) in each part's own unit
    rest: Array  # (A,) length at rest [m]; of a chamber, volume at rest
    friction: Array  # (A,) coefficient of friction [1]


own_symbols(Levels)


def _no_regions(region: Any, x: Array, particle: Array) -> Array:
    """Raise UsageError: the default of `Skin.pick`."""
    raise UsageError("no region can be found here")


class Skin(NamedTuple):
    """The surface of a body at rest, for forces on it.

    Attributes:
        x: its points (S, D) [m].
        particle: the nearest particle of the body to each (S,).
        facets: (T, D) the points of each segment or triangle, with normals out of the body.
        pick: (region or its name, points (n, D) [m], particles next to them (n,)) -> which of them it contains (n,).
    """

    x: Array
    particle: Array
    facets: Array
    pick: Callable[[Any, Array, Array], Array] = _no_regions


class Riding(NamedTuple):
    """Points that a force acts on, each of which rides on a particle.

    Attributes:
        particle: (n,).
        x: where the points are at rest (n, D) [m].
        constants: the other numbers for the force's kernel.
    """

    particle: Array
    x: Array
    constants: Array


class ParticleForce(Plugin):
    """A force on particles that depends on their positions and has no activation.

    A force may have several parts, each with its own strength and rest length.
    """

    scale: ClassVar[str] = ""
    """The differentiable field that is the strength of a part."""

    kernel: ClassVar[type]
    """The class of the kernels' view."""

    def parts(self) -> tuple[str, ...]:
        """Return the names of its parts; a single part has an empty name."""
        return ("",)

    @abstractmethod
    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles of a part.

        Args:
            part: one of `parts`.
            x: all particles at rest (N, D) [m].
            inside: finds the particles of a body and region.
        """

    def riding(self, part: str, skin: Callable[[], Skin]) -> Riding | None:
        """Return the points that a part acts on, in place of particles; None if it acts on particles.

        Args:
            part: one of `parts`.
            skin: returns the surface of its body.

        Raises:
            UsageError: there are no such points.
        """
        return None

    def constants(self, x: Array) -> Array:
        """Return a part's other numbers for its kernel, for its particles at rest x (n, D) [m]."""
        return np.zeros(0)

    def rest_length(self, x: Array) -> float:
        """Return the length at rest [m] of a part whose particles at rest are x (n, D) [m]; 0 if it has none."""
        return 0.0

    def rest_length_vjp(self, x: Array, bar: float) -> Array:
        """Return the cotangent of x (n, D)."""
        return np.zeros(x.shape)

    def rest_size(self, x: Array, constants: Array) -> float:
        """Return the length at rest, or another size, of a part whose points at rest are x (n, D) [m]; see `Levels`."""
        return self.rest_length(x)

    def rest_size_vjp(self, x: Array, constants: Array, bar: float) -> Array:
        """Return the cotangent of x (n, D)."""
        return self.rest_length_vjp(x, bar)

    def problem(self, x: Array, dx: float) -> str | None:
        """Return the error in a part whose particles at rest are x (n, D) [m], with cells of dx [m], or None."""
        return None

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness that a part adds to the grid nodes near its particles, at rest at x (n, D) [N/m]."""
        return 0.0


def register_force(
    kernel_class: type, items: Callable[[Array, Array], list[Array]], exert: Callable[..., None],
    exert_vjp: Callable[..., None], *, rate: bool = True, own: slice = slice(None),
    exert_jvp: Callable[..., None] | None = None,
) -> None:  # fmt: skip
    """Register the functions of a kernel class.

    Args:
        kernel_class: a NamedTuple of `shares`, `parts` and `constants` (I, ...), one row per item.
        items: returns the particles of each item of a part, for its particles (n,) and constants.
        exert, exert_vjp: see the top of this file.
        rate: whether the force depends on velocities.
        own: which of a part's constants each of its items has in the kernel's view.
        exert_jvp: of a force without a potential; see the top of this file.
    """
    _RATES.update([kernel_class] if rate else [])
    _UNSYMMETRIC.update([] if exert_jvp is None else [kernel_class])
    _EXERT.register(kernel_class, exert)
    _EXERT_VJP.register(kernel_class, exert_vjp)
    _EXERT_JVP.register(kernel_class, exert_jvp or exert_vjp)
    _ITEMS[kernel_class], _OWN[kernel_class] = items, own


def needs_velocity(kernel_class: type) -> bool:
    """Return whether a force of a kernel class depends on velocities."""
    return kernel_class in _RATES


def is_unsymmetric(kernel_class: type) -> bool:
    """Return whether a force of a kernel class has no potential, so that its tangent is not symmetric."""
    return kernel_class in _UNSYMMETRIC


def is_force(kernel_class: type) -> bool:
    """Return whether a kernel class belongs to a force that depends on the state."""
    return kernel_class in _ITEMS


class Kind(NamedTuple):
    """All parts of one kind of force: their numbers among all parts, the columns of their particles, the constants."""

    kernel: type
    parts: Array
    columns: Sequence[Array]
    constants: Sequence[Array]


def make_forces(kinds: Sequence[Kind], dim: int) -> tuple[tuple[Any, ...], Shares]:
    """Return the kernels' view of every kind, and the shares of all kinds, of which those of a kind are a view."""
    pulled = [
        [(int(a), item, c[_OWN[k.kernel]]) for a, columns, c in zip(k.parts, k.columns, k.constants, strict=True)
         for item in _ITEMS[k.kernel](columns, c)]
        for k in kinds
    ]  # fmt: skip
    everything = [entry for kind in pulled for entry in kind]
    all_shares = _shares([item for _, item, _ in everything], dim)
    views, first_item = [], 0
    for kind, entries in zip(kinds, pulled, strict=True):
        shares = _piece(all_shares, first_item, first_item + len(entries))
        constants = np.array([c for *_, c in entries], float).reshape(len(entries), -1)
        views.append(kind.kernel(shares, np.array([a for a, *_ in entries], np.int64), constants))
        first_item += len(entries)
    return tuple(views), all_shares


def _shares(items: Sequence[Array], dim: int) -> Shares:
    """Return shares of zero for the particles of each item."""
    begin = np.cumsum([0, *map(len, items)]).astype(np.int64)
    columns = np.concatenate([np.zeros(0, np.int64), *items]).astype(np.int64)
    force, x_bar, v_bar = (np.zeros((len(columns), dim)) for _ in range(3))
    return Shares(begin, columns, force, x_bar, v_bar, np.zeros((len(items), 4)))


def _piece(shares: Shares, first: int, last: int) -> Shares:
    """Return a view of the shares of items first .. last; only `begin` is a copy."""
    piece = slice(int(shares.begin[first]), int(shares.begin[last]))
    arrays = (a[piece] for a in (shares.columns, shares.force, shares.x_bar, shares.v_bar))
    return Shares(shares.begin[first : last + 1] - piece.start, *arrays, shares.level_bar[first:last])

"""The box, the clamp and the cells of a body: what a user has measured, and for the rest what the markers suggest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.build.check_units import HEAVY, LIGHT
from cqrun.errors import UsageError
from cqrun.geometry.lattice import whole_spacing
from cqrun.jobs.new.seen import Seen
from cqrun.plugin.contract import Array

IN_CLAMP = 3.0
"""Cells of the body's length that are in the clamp."""

THIN = 0.2
"""A body is at least so thick, as a part of its length; markers often lie on one face."""

CELLS, PARTICLES = {2: 4.0, 3: 3.0}, 8000
"""Cells across the thinnest part, and the largest number of particles; with more, cells are larger."""

PER_CELL, PER_AXIS = {2: 4, 3: 8}, 2
"""Particles in a cell, and along each of its edges."""

STEM, FAR_LARGER = 0.25, 20.0
"""A marker stands off a body by at most this part of its length; a body is at most so many times as long."""

NICE = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)


@dataclass(frozen=True)
class Given:
    """What a user has measured, in m and along the axes of the file; what is None is guessed.

    Attributes:
        size, corner: edges of the body's box, and its lower corner (D,).
        clamp: length of the body that is held.
        density: [kg/m^3].
    """

    size: Sequence[float] | None = None
    corner: Sequence[float] | None = None
    clamp: float | None = None
    density: float | None = None

    @property
    def fewest(self) -> int:
        """The smallest number of markers with which the rest can be guessed."""
        return 2 if self.size is None else 1

    def require_fit(self, dim: int) -> None:
        """Raise UsageError for numbers that belong to no body in so many dimensions."""
        for option, numbers in (("size", self.size), ("corner", self.corner)):
            if numbers is not None and len(numbers) != dim:
                raise UsageError(f"--{option} has {len(numbers)} numbers, but the recording has {dim} axes")
        positive = {"size": self.size or (), "clamp": (self.clamp,), "density": (self.density,)}
        for option, given in positive.items():
            if any(number is not None and not 0 < number < np.inf for number in given):
                raise UsageError(f"--{option}: takes numbers above 0, lengths in m")
        if self.density is not None and not LIGHT <= self.density <= HEAVY:
            raise UsageError(f"--density {self.density:g}: no soft robot is so light or heavy; give it in kg/m^3")
        if self.clamp is not None and self.size is not None and self.clamp >= max(self.size):
            raise UsageError(f"--clamp {self.clamp:g}: nothing of a body of {max(self.size):g} m would be free")


@dataclass(frozen=True)
class Lengths:
    """The lower and upper corner of a body (D,), where its clamp ends along its length, and the edge of cells [m]."""

    low: Array
    high: Array
    face: float
    dx: float

    @property
    def size(self) -> Array:
        """Edges of the body (D,) [m]."""
        return self.high - self.low


def body_lengths(seen: Seen, along: int, side: int, given: Given) -> Lengths:
    """Return the lengths of a body that is held at its lower (side -1) or upper (side 1) end along an axis."""
    return _around_markers(seen, along, side, given) if given.size is None else _measured(seen, along, side, given)


def _measured(seen: Seen, along: int, side: int, given: Given) -> Lengths:
    """Return the lengths of a body whose edges are given.

    Without a corner, its free end is where its last markers are, and across its length they are in the middle.
    """
    size, low = np.asarray(given.size, float), seen.rest.min(axis=0)
    dx = _whole_cell(size)
    if given.corner is None:
        low = 0.5 * (low + seen.rest.max(axis=0) - size)
        low[along] = seen.rest[:, along].max() - size[along] if side < 0 else seen.rest[:, along].min()
    else:
        low = np.asarray(given.corner, float)
    _require_near(seen, low, low + size)
    end = float(low[along] if side < 0 else low[along] + size[along])
    held = -side * (_held_face(seen, along, side) - end)  # length between this end and the markers that hardly move
    if given.clamp is not None:
        held = given.clamp
    elif not (seen.held.any() and 0 < held < size[along]):
        held = min(IN_CLAMP * dx, 0.5 * float(size[along]))
    return Lengths(low, low + size, end - side * held, dx)


def _require_near(seen: Seen, low: Array, high: Array) -> None:
    """Raise a UsageError if a marker is farther off a body (D,) than a stem would carry it."""
    off = np.linalg.norm(np.maximum(np.maximum(low - seen.rest, seen.rest - high), 0.0), axis=1)
    apart, length = float(np.ptp(seen.rest, axis=0).max()), float((high - low).max())
    if len(seen.rest) > 1 and length > FAR_LARGER * apart:
        raise UsageError(
            f"--size: the body would be {length:.4g} m long, and its markers are {apart:.3g} m apart; give edges in m"
        )
    if off.max() > STEM * length:
        raise UsageError(
            f"--size, --corner: marker '{seen.names[int(np.argmax(off))]}' would be {1e3 * off.max():.3g} mm outside "
            "the body: give edges and corner in the order of the file's axes, in m"
        )


def _around_markers(seen: Seen, along: int, side: int, given: Given) -> Lengths:
    """Return the lengths of a box around the markers; its edges are multiples of the distance between particles."""
    low, high = _box(seen.rest)
    if given.corner is not None:
        low = np.asarray(given.corner, float)
        high = np.maximum(high, low + THIN * float(np.max(high - low)))
    dx = _cell(high - low)
    spacing = dx / PER_AXIS
    end = float((low if side < 0 else high)[along])
    face = _held_face(seen, along, side) if seen.held.any() else end
    held = IN_CLAMP * dx if given.clamp is None else given.clamp
    if given.corner is not None and side < 0:
        face = end + held
    (low if side < 0 else high)[along] = face + side * held
    more = spacing * np.maximum(np.round((high - low) / spacing), 2) - (high - low)
    shares = np.full(len(low), 0.5 if given.corner is None else 0.0)
    shares[along] = 1.0 if side < 0 and given.corner is None else 0.0  # the free end stays where its markers are
    return Lengths(low - shares * more, high + (1.0 - shares) * more, face, dx)


def _held_face(seen: Seen, along: int, side: int) -> float:
    """Return the place of the marker that hardly moves and is nearest to the free end [m]; 0 if there is none."""
    held = seen.rest[seen.held][:, along]
    return float(held.max() if side < 0 else held.min()) if len(held) else 0.0


def _box(rest: Array) -> tuple[Array, Array]:
    """Return the corners (D,) of a box around markers (M, D), which is not too thin."""
    low, high = rest.min(axis=0), rest.max(axis=0)
    lack = np.maximum(THIN * float(np.max(high - low)) - (high - low), 0.0)
    return low - 0.5 * lack, high + 0.5 * lack


def _cell(size: Array) -> float:
    """Return the edge of the cells for a body of a size (D,) [m]."""
    dim = len(size)
    dx = min(float(size.min()) / CELLS[dim], float(size.max()) / 8.0)
    fewest = (float(np.prod(size)) * PER_CELL[dim] / PARTICLES) ** (1.0 / dim)
    return nice(max(dx, fewest), up=fewest > dx)


def _whole_cell(size: Array) -> float:
    """Return an edge of cells near that of `_cell`, with which every edge (D,) is a whole number of particles."""
    about = _cell(size)
    spacing = whole_spacing(size, about / PER_AXIS, PER_AXIS)
    return about if spacing is None else float(f"{PER_AXIS * spacing:.6g}")


def world_corners(seen: Seen, body: Lengths) -> tuple[Array, Array]:
    """Return the corners (D,) of a world in which the body can move half as far again as its markers do."""
    least, most = np.nanmin(seen.positions, axis=(0, 1)), np.nanmax(seen.positions, axis=(0, 1))
    room = 3.0 * body.dx + 0.5 * (most - least - np.ptp(seen.rest, axis=0)).clip(min=0.0)
    return np.minimum(body.low, least) - room, np.maximum(body.high, most) + room


def world_shift(low: Array, high: Array, dx: float) -> Array:
    """Return what is added to positions of the file (D,) [m], so that a world from 0 on holds what is between corners.

    It is 0 along an axis where the file's numbers begin above 0, and not farther from there than the world is long.
    """
    fits = (low >= 0.0) & (low <= float((high - low).max()))
    return np.asarray(np.where(fits, 0.0, dx * np.ceil(-low / dx)))


def nice(number: float, *, up: bool = False) -> float:
    """Return a number with few digits that is not larger, or with `up` not smaller."""
    power = 10.0 ** np.floor(np.log10(number))
    steps = [float(f"{power * step:.3g}") for step in (*NICE, 10.0)]
    slack = 1e-6 * number
    return min(s for s in steps if s >= number - slack) if up else max(s for s in steps if s <= number + slack)

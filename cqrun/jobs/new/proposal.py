"""What a scene for a recording may look like: a box around the markers, a clamp, gravity, a stiffness, times, bounds.

Every number is a guess from what the recording shows (seen.py), and the scene says so. A body is taken as a beam or a
bar along the direction in which its markers are far apart, held at the end that moves least.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cqrun.jobs.new.seen import Seen, names_of
from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array

MILLI = 1e3
GRAVITY, DENSITY, POISSON = 9.81, 1070.0, 0.45
"""On earth [m/s^2]; silicone rubber [kg/m^3], and its ratio as far as the grid takes it without averaged volumes."""

SOFT, STIFF, NO_RHYTHM = 1e3, 1e9, 1e5
"""Least and largest Young's modulus that is proposed, and the one if nothing tells it [Pa]."""

DECADE = 10.0
"""Young's modulus is searched up to this factor from its start; viscosity down to its square, and up to its half."""

LOSS = 0.03
"""Viscosity times the circular frequency, as a part of Young's modulus, at the start."""

IN_CLAMP = 3.0
"""Cells of the body's length that are in the clamp."""

FRAMES, LATE = 3, 0.03
"""Frames by which the run may begin earlier or later, or the part of a period."""

THIN = 0.2
"""A body is at least so thick, as a part of its length; markers often lie on one face."""

CELLS, PARTICLES = {2: 4.0, 3: 3.0}, 8000
"""Cells across the thinnest part, and the largest number of particles; with more, cells are larger."""

PER_CELL = {2: 4, 3: 8}
PERIODS, LONGEST = 8.0, 2.0
"""The motion lasts so many periods, or so long without a rhythm [s]."""

STEPS, MOST_STEPS = 12.0, 400
"""Control steps in a period, and in a run."""

CLEAR = 2.0
"""The markers sink along an axis if they move so many times as far along it as along the others."""

NICE = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
LARGEST_BODY = 10.0
"""Markers that are farther apart are in millimetres [m]."""

AXES = "xyz"


@dataclass(frozen=True)
class Proposal:
    """The numbers of a scene; lengths in m in its own axes.

    Attributes:
        names, places: of the markers (M,), and where they are at rest (M, D).
        corner, size: of the body (D,).
        clamp: corner and size of the region that is held (D,).
        start, starts: when the run begins in the file, and the bounds if that is fitted [s].
        still: frames at rest, which align the file to the markers at rest [s], or None.
        offset: (D,) to be added to the positions of the file, or None if the still frames align them.
        shift, degrees: what is added to positions of the file, after they are turned about the vertical.
        guesses: what is guessed, by the name of the line that says so.
    """

    names: tuple[str, ...]
    places: Array
    corner: Array
    size: Array
    clamp: tuple[Array, Array]
    world: Array
    dx: float
    gravity: Array
    modulus: float
    viscosity: float
    duration: float
    control_step: float
    start: float
    starts: tuple[float, float] | None
    still: tuple[float, float] | None
    offset: Array | None
    shift: Array
    degrees: float
    guesses: dict[str, str] = field(default_factory=dict)


def propose(seen: Seen) -> Proposal:
    """Return a proposal for a recording."""
    guesses: dict[str, str] = {}
    down, sign, guesses["gravity"] = _down(seen)
    aligned = seen.still is not None and _spans(seen.rest)
    seen, degrees = _turned(seen, down) if aligned else (seen, 0.0)
    along, side, guesses["clamp"] = _held_end(seen)
    low, high, face, dx = _body(seen, along, side)
    guesses["body"] = (
        f"the body is a box around the markers, {' x '.join(f'{MILLI * edge:.3g}' for edge in high - low)} mm: measure "
        f"yours; {MILLI * IN_CLAMP * dx:.3g} mm of its length are in the clamp"
    )
    free = float(abs((high if side < 0 else low)[along] - face))
    modulus, guesses["stiffness"] = _modulus(seen, free, high - low, along)
    inside, outside = _world(seen, low, high, dx)
    shift = dx * np.ceil(-inside / dx)
    world = dx * np.ceil((outside + shift) / dx)
    begin, end = np.zeros(len(low)), world.copy()
    (end if side < 0 else begin)[along] = face + shift[along]
    control, duration = _times(seen)
    guesses["start"], doubt = _start_guess(seen), max(FRAMES * seen.frame, LATE * (seen.period or 0.0))
    return Proposal(
        names=seen.names, places=seen.rest + shift, corner=low + shift, size=high - low, clamp=(begin, end - begin),
        world=world, dx=dx, gravity=sign * GRAVITY * np.eye(len(low))[down], modulus=modulus,
        viscosity=_nice(LOSS * modulus * (seen.period or 0.2) / (2 * np.pi)), duration=duration, control_step=control,
        start=seen.start, starts=None if seen.still is None else (
            max(seen.start - doubt, seen.still[1]), seen.start + doubt
        ),
        still=seen.still if aligned else None, offset=None if aligned else shift, shift=shift, degrees=degrees,
        guesses=guesses,
    )  # fmt: skip


def unit_guess(recording: Recording) -> str | None:
    """Return the unit in which positions must be that were read as metres, or None if metres are likely."""
    first = np.nanmedian(recording.positions, axis=0)
    extent = float(np.max(np.nanmax(first, axis=0) - np.nanmin(first, axis=0)))
    return "mm" if extent > LARGEST_BODY else None


# --- axes -------------------------------------------------------------------------------------------------------


def _down(seen: Seen) -> tuple[int, float, str]:
    """Return the axis along which gravity acts, its sign, and the reason."""
    dim = len(seen.drift)
    order = np.argsort(np.abs(seen.drift))[::-1]
    axis, sink = int(order[0]), float(seen.drift[order[0]])
    clear = abs(sink) > CLEAR * abs(float(seen.drift[order[1]])) and abs(sink) > 0.1 * float(seen.moved.max())
    if seen.still is not None and clear:
        return axis, float(np.sign(sink)), (
            f"gravity is along {'-' if sink < 0 else '+'}{AXES[axis]}: from their rest the markers sink that way, by "
            f"{MILLI * abs(sink):.2g} mm"
        )  # fmt: skip
    return dim - 1, -1.0, f"gravity is along -{AXES[dim - 1]}: the recording does not show it"


def _spans(rest: Array) -> bool:
    """Return whether markers at rest (M, D) determine how a body is turned: enough of them, and not on one line."""
    extents = np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)
    dim = rest.shape[1]
    return len(rest) >= dim and bool(extents[dim - 2] > 0.05 * extents[0])


def _turned(seen: Seen, down: int) -> tuple[Seen, float]:
    """Return what was seen, turned about the vertical so that a box around it is small, and the angle [degrees]."""
    if seen.rest.shape[1] == 2:
        return seen, 0.0
    flat = [k for k in range(3) if k != down]

    def rotation(degrees: float) -> Array:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        matrix = np.eye(3)
        matrix[np.ix_(flat, flat)] = [[c, -s], [s, c]]
        return matrix

    def area(degrees: float) -> float:
        return float(np.prod(np.ptp((seen.rest @ rotation(degrees).T)[:, flat], axis=0)))

    best = min(np.arange(-45.0, 45.0, 0.5).tolist(), key=area)
    if area(best) > 0.8 * area(0.0):
        return seen, 0.0
    return seen.turned(rotation(best)), best


def _held_end(seen: Seen) -> tuple[int, int, str]:
    """Return the axis of a body, at which end it is held (-1 or 1), and the reason."""
    held, extent = seen.held, np.ptp(seen.rest, axis=0)
    if held.any():
        apart = seen.rest[~held].mean(axis=0) - seen.rest[held].mean(axis=0)
        axis = int(np.argmax(np.abs(apart)))
        return axis, -1 if apart[axis] > 0 else 1, (
            f"the body is held up to the markers that hardly move: {names_of(seen, held)}"
        )  # fmt: skip
    offset = seen.rest - seen.rest.mean(axis=0)
    slopes = offset.T @ (seen.moved - seen.moved.mean()) / np.maximum(np.sum(offset**2, axis=0), 1e-12) * extent
    axis = int(np.argmax(np.abs(slopes))) if slopes.any() else int(np.argmax(extent))
    return axis, -1 if slopes[axis] >= 0 else 1, "the body is held at the end that moves least; no marker stands still"


# --- lengths ----------------------------------------------------------------------------------------------------


def _box(rest: Array) -> tuple[Array, Array]:
    """Return the corners (D,) of a box around markers (M, D), which is not too thin."""
    low, high = rest.min(axis=0), rest.max(axis=0)
    lack = np.maximum(THIN * float(np.max(high - low)) - (high - low), 0.0)
    return low - 0.5 * lack, high + 0.5 * lack


def _body(seen: Seen, along: int, side: int) -> tuple[Array, Array, float, float]:
    """Return the corners of the body (D,), where its clamp ends along its length, and the edge of the cells [m].

    The edges of the body are multiples of the distance between particles.
    """
    low, high = _box(seen.rest)
    dx = _cell(high - low)
    face = float((low if side < 0 else high)[along])
    if seen.held.any():
        held = seen.rest[seen.held][:, along]
        face = float(held.max() if side < 0 else held.min())
    (low if side < 0 else high)[along] = face + side * IN_CLAMP * dx
    spacing = dx / 2  # of 4 particles per cell in 2D, and 8 in 3D
    more = spacing * np.maximum(np.round((high - low) / spacing), 2) - (high - low)
    shares = np.full(len(low), 0.5)
    shares[along] = 1.0 if side < 0 else 0.0  # the free end stays where its markers are
    return low - shares * more, high + (1.0 - shares) * more, face, dx


def _cell(size: Array) -> float:
    """Return the edge of the cells for a body of a size (D,) [m]."""
    dim = len(size)
    dx = min(float(size.min()) / CELLS[dim], float(size.max()) / 8.0)
    fewest = (float(np.prod(size)) * PER_CELL[dim] / PARTICLES) ** (1.0 / dim)
    return _nice(max(dx, fewest), up=fewest > dx)


def _world(seen: Seen, low: Array, high: Array, dx: float) -> tuple[Array, Array]:
    """Return the corners (D,) of a world in which the body can move half as far again as its markers do."""
    least, most = np.nanmin(seen.positions, axis=(0, 1)), np.nanmax(seen.positions, axis=(0, 1))
    room = 3.0 * dx + 0.5 * (most - least - np.ptp(seen.rest, axis=0)).clip(min=0.0)
    return np.minimum(low, least) - room, np.maximum(high, most) + room


def _nice(number: float, *, up: bool = False) -> float:
    """Return a number with few digits that is not larger, or with `up` not smaller."""
    power = 10.0 ** np.floor(np.log10(number))
    steps = [float(f"{power * step:.3g}") for step in (*NICE, 10.0)]
    slack = 1e-6 * number
    return min(s for s in steps if s >= number - slack) if up else max(s for s in steps if s <= number + slack)


# --- stiffness and times ----------------------------------------------------------------------------------------


def _modulus(seen: Seen, free: float, size: Array, along: int) -> tuple[float, str]:
    """Return a Young's modulus [Pa] with which the body has the rhythm of the markers, and the reason.

    The first frequency of a clamped beam is 1.875^2 / (2 pi) sqrt(E h^2 / (12 rho L^4)), and that of a bar that is
    stretched sqrt(E / rho) / (4 L).
    """
    if seen.period is None:
        return (
            NO_RHYTHM,
            "the start of the search for Young's modulus: the recording has no rhythm to tell it",
        )
    swing = int(np.argmax(np.nanmax(np.nanstd(seen.positions, axis=0), axis=0)))
    if swing == along:
        modulus = DENSITY * (4.0 * free / seen.period) ** 2
    else:
        modulus = 12.0 * DENSITY / float(size[swing]) ** 2 * (2 * np.pi * free**2 / (1.875**2 * seen.period)) ** 2
    modulus = float(f"{np.clip(modulus, SOFT, STIFF):.2g}")
    kind = "bar" if swing == along else "beam"
    rate = 1.0 / seen.period
    return modulus, f"the start of the search for Young's modulus: of a {kind} of this size that moves at {rate:.3g} Hz"


def _times(seen: Seen) -> tuple[float, float]:
    """Return the control step and the duration of a run [s]."""
    end = float(seen.time[-1]) - 2 * seen.frame
    later = [begin for begin, _ in seen.rests if begin > seen.start]
    wanted = PERIODS * seen.period if seen.period else min(LONGEST, (later[0] if later else np.inf) - seen.start)
    duration = max(min(wanted, end - seen.start - 2 * seen.frame), 2 * seen.frame)
    control = _nice(min((seen.period or duration) / STEPS, duration / 2))
    control = max(control, _nice(duration / MOST_STEPS, up=True))
    return control, control * max(1, int(duration / control + 1e-9))


def _start_guess(seen: Seen) -> str:
    """Return the reason for the start of the run."""
    if seen.still is None:
        return (
            "the run begins at the first frame, with the body at rest and undeformed: no rest comes before the motion"
        )
    return f"the motion begins at {seen.start:.4g} s, after a rest; the body is undeformed there"

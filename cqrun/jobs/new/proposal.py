"""What a scene for a recording may look like: a box around the markers, a clamp, gravity, a stiffness, times, bounds.

Every number is a guess from what the recording shows (seen.py), and the scene says so. A body is taken as a beam or a
bar along the direction in which its markers are far apart, held at the end that moves least.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from cqrun.jobs.new.lengths import Given, Lengths, body_lengths, nice, world_corners, world_shift
from cqrun.jobs.new.seen import Seen, names_of
from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array

MILLI = 1e3
GRAVITY, DENSITY, POISSON = 9.81, 1070.0, 0.45
"""On earth [m/s^2]; silicone rubber [kg/m^3], and its ratio as far as the grid takes it without averaged volumes."""

SOFT, STIFF, NO_RHYTHM = 1e3, 1e9, 1e5
"""Least and largest Young's modulus that is proposed, and the one if nothing tells it [Pa]."""

MEASURED, GUESSED = 5.0, 50.0
"""Young's modulus is searched up to this factor from its start. It grows with the fourth power of a length, so the
second factor is for a body whose size is a guess; a stiffer bound needs shorter substeps."""

FRAMES, LATE = 3, 0.03
"""Frames by which the run may begin earlier or later, or the part of a period."""

PERIODS, LONGEST = 8.0, 2.0
"""The motion lasts so many periods, or so long without a rhythm [s]."""

STEPS, MOST_STEPS = 12.0, 400
"""Control steps in a period, and in a run."""

CLEAR = 2.0
"""The markers sink along an axis if they move so many times as far along it as along the others."""

LARGEST_BODY = 10.0
"""Markers that are farther apart are in millimetres [m]."""

ROUNDING = 1e-9
"""Part of a cell that adds no cell to the world."""

AXES = "xyz"
NOTHING = Given()


@dataclass(frozen=True)
class Proposal:
    """The numbers of a scene; lengths in m in its own axes.

    Attributes:
        names, places: of the markers (M,), and where they are at rest (M, D).
        corner, size: of the body (D,).
        clamp: corner and size of the region that is held (D,).
        reach: factor up to which Young's modulus is searched from its start.
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
    density: float
    modulus: float
    reach: float
    duration: float
    control_step: float
    start: float
    starts: tuple[float, float] | None
    still: tuple[float, float] | None
    offset: Array | None
    shift: Array
    degrees: float
    guesses: dict[str, str] = field(default_factory=dict)


def propose(seen: Seen, given: Given = NOTHING) -> Proposal:
    """Return a proposal for a recording.

    Raises:
        UsageError: what is given does not fit the recording.
    """
    given.require_fit(seen.rest.shape[1])
    guesses: dict[str, str] = {}
    down, sign, guesses["gravity"] = _down(seen)
    aligned = seen.still is not None and _spans(seen.rest)
    seen, degrees = _turned(seen, down) if aligned and given.size is None and given.corner is None else (seen, 0.0)
    along, side, guesses["clamp"] = _held_end(seen, given)
    body = body_lengths(seen, along, side, given)
    if given.clamp is not None:
        del guesses["clamp"]
    guesses.update(_body_guess(body, given))
    density = DENSITY if given.density is None else given.density
    free = float(abs((body.high if side < 0 else body.low)[along] - body.face))
    modulus, guesses["stiffness"] = _modulus(seen, free, body.size, along, density)
    inside, outside = world_corners(seen, body)
    shift = world_shift(inside, outside, body.dx)
    world = body.dx * np.ceil((outside + shift) / body.dx - ROUNDING)
    begin, end = np.zeros(len(world)), world.copy()
    (end if side < 0 else begin)[along] = body.face + shift[along]
    control, duration = _times(seen)
    guesses["start"], doubt = _start_guess(seen), max(FRAMES * seen.frame, LATE * (seen.period or 0.0))
    return Proposal(
        names=seen.names, places=seen.rest + shift, corner=body.low + shift, size=body.size,
        clamp=(begin, end - begin), world=world, dx=body.dx, gravity=sign * GRAVITY * np.eye(len(world))[down],
        density=density, modulus=modulus, reach=MEASURED if given.size is not None else GUESSED,
        duration=duration, control_step=control,
        start=seen.start, starts=None if seen.still is None else (
            max(seen.start - doubt, seen.still[1]), seen.start + doubt
        ),
        still=seen.still if aligned else None, offset=None if aligned or not shift.any() else shift, shift=shift,
        degrees=degrees, guesses=guesses,
    )  # fmt: skip


def _body_guess(body: Lengths, given: Given) -> Iterator[tuple[str, str]]:
    """Yield what is a guess of the body, by the name of the line that says so."""
    size = " x ".join(f"{MILLI * edge:.3g}" for edge in body.size)
    if given.size is None:
        where = "a box around the markers" if given.corner is None else "a box from your corner on to the markers"
        yield "body", f"the body is {where}, {size} mm: measure yours, and give it with --size"
    elif given.corner is None:
        yield "body", "the free end of the body is where its last markers are, and across it they are in the middle"


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


def _held_end(seen: Seen, given: Given) -> tuple[int, int, str]:
    """Return the axis of a body, at which end it is held (-1 or 1), and the reason."""
    held, extent = seen.held, np.ptp(seen.rest, axis=0)
    if len(seen.rest) == 1:
        return _end_away_from(seen.rest[0], given)
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


def _end_away_from(marker: Array, given: Given) -> tuple[int, int, str]:
    """Return along which axis a body of a given size is held, and at which end, from where its only marker is (D,)."""
    size = np.asarray(given.size, float)
    axis = int(np.argmax(size))
    if given.corner is None:
        return axis, -1, f"the body is held at its end of smaller {AXES[axis]}; a single marker does not tell"
    side = -1 if marker[axis] > given.corner[axis] + 0.5 * size[axis] else 1
    return axis, side, "the body is held at the end that is far from its only marker"


# --- stiffness and times ----------------------------------------------------------------------------------------


def _modulus(seen: Seen, free: float, size: Array, along: int, density: float) -> tuple[float, str]:
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
        modulus = density * (4.0 * free / seen.period) ** 2
    else:
        modulus = 12.0 * density / float(size[swing]) ** 2 * (2 * np.pi * free**2 / (1.875**2 * seen.period)) ** 2
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
    control = nice(min((seen.period or duration) / STEPS, duration / 2))
    control = max(control, nice(duration / MOST_STEPS, up=True))
    return control, control * max(1, int(duration / control + 1e-9))


def _start_guess(seen: Seen) -> str:
    """Return the reason for the start of the run."""
    if seen.still is None:
        return "the run begins at the first frame, with the body undeformed; the first frames show where markers rest"
    return f"the motion begins at {seen.start:.4g} s, after a rest; the body is undeformed there"

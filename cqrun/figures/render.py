"""Movies and stills of a run's trajectory, for `cqrun render`; frames are read and drawn one at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.actuators.cable import Cable
from cqrun.build.assembly import Assembly
from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.figures.choices import Kind
from cqrun.figures.colours import colours, sampled
from cqrun.figures.dots import Dots
from cqrun.figures.movie import ffmpeg, gif_delay, write_gif, write_mp4, write_png
from cqrun.figures.picture import Picture, Stage, Trails
from cqrun.figures.run_data import TRAJECTORY, RunData, read_run
from cqrun.figures.scenery import goals, seen
from cqrun.figures.solid import require_pyvista
from cqrun.figures.style import styled
from cqrun.figures.views import PLANE, View, view
from cqrun.plugin.contract import Array
from cqrun.running.reporter import Reporter, Silent
from cqrun.store.atomic import make_directory
from cqrun.store.frames import Frames

MOVIE_DPI, STILL_DPI = 110.0, 220.0

PALEST = 0.78
"""How much white the first of several instants in one picture is mixed with."""

SAMPLES = 5
"""Pictures that the palette of a GIF is made of."""

MOST_TIMES = 6
"""Instants whose times are all told."""

NO_TRAIL = "none"


@dataclass(frozen=True)
class Wanted:
    """What to draw.

    Attributes:
        kind: a movie (gif, mp4), the last frame (png), several pictures, or several instants in one.
        count: how many stills or instants.
        color: one of `choices.Quantity`; what suits the run if None.
        fps: pictures a second of a movie.
        every: only every so many frames of the trajectory.
        view: one of `choices.Look`, of a world of three dimensions; iso if None.
        trail: body, group or body.group whose path is drawn; every body's if None; `none` for no path.
        output: file; `figures/` of the run if None.
    """

    kind: Kind = "gif"
    count: int = 6
    color: str | None = None
    fps: float = 25.0
    every: int = 1
    view: str | None = None
    trail: str | None = None
    output: Path | None = None


def _no_frames(run: RunData) -> str:
    if run.job in ("control", "codesign"):
        return "a learned motion is written in the end; `cqrun simulate RUN` runs the best controller so far"
    return "nothing to draw before the first frame"


def render(path: Path, wanted: Wanted, talk: Reporter | None = None) -> list[Path]:
    """Draw the trajectory of a run, as far as it is written; return the files.

    Raises:
        UsageError: it is no run or has no frames, or what is wanted cannot be had of it.
        MissingExtra: pyvista or ffmpeg is needed and absent.
        Stopped: it was asked to stop; nothing is left behind.
        RunError: the disk is full.
    """
    talk = talk or Silent()
    run = read_run(path)
    if not run.has_trajectory():
        raise UsageError(f"{path}: there is no {TRAJECTORY}: {_no_frames(run)}")
    if wanted.kind == "mp4":
        ffmpeg()
    if run.scene.dim == 3:
        require_pyvista()
    with Frames(path / TRAJECTORY) as frames, styled():
        shown = shown_frames(len(frames), wanted)
        talk.phase(f"looking at {len(shown)} of {len(frames)} frames")
        stage = set_stage(run, frames, shown, wanted)
        output = wanted.output or path / "figures" / _name(wanted, stage)
        make_directory(output.parent)
        return _draw(stage, frames, shown, wanted, output, talk)


def shown_frames(count: int, wanted: Wanted) -> list[int]:
    """Return the frames that are drawn: the last one, several spread over the time, or every so many.

    Raises:
        UsageError: there are too few.
    """
    if count == 0:
        raise UsageError(f"{TRAJECTORY}: no frame in it yet, so there is nothing to draw")
    every = list(range(0, count, wanted.every))
    if wanted.kind in ("gif", "mp4"):
        return every
    if wanted.kind == "png":
        return [count - 1]
    if wanted.count > count:
        raise UsageError(f"--{wanted.kind} {wanted.count}: the trajectory has only {count} frames")
    return [int(k) for k in np.round(np.linspace(0, count - 1, wanted.count))]


def _name(wanted: Wanted, stage: Stage) -> str:
    what = {"gif": "motion", "mp4": "motion", "png": "last", "stills": "still", "onion": "onion"}[wanted.kind]
    suffix = wanted.kind if wanted.kind in ("gif", "mp4") else "png"
    return f"{what}_{stage.quantity}.{suffix}"


# --- the stage ----------------------------------------------------------------------------------------------


def set_stage(run: RunData, frames: Frames, shown: Sequence[int], wanted: Wanted) -> Stage:
    """Return what stays the same in all pictures; it reads every frame shown, one at a time."""
    rest = frames.read("x", 0)
    if run.scene.dim == 2 and wanted.view is not None:
        view(run.scene, rest, wanted.view)  # says that there is nothing to choose
    box = np.array([rest.min(axis=0), rest.max(axis=0)])
    followed = followed_particles(run, frames, wanted.trail)
    passed = range(0, shown[-1] + 1, wanted.every)
    paths: dict[str, list[Array]] = {name: [] for name in followed}
    for frame in passed:
        x = frames.read("x", frame)
        box = np.array([np.minimum(box[0], x.min(axis=0)), np.maximum(box[1], x.max(axis=0))])
        for name, particles in followed.items():
            paths[name].append(x[particles].mean(axis=0))
    trails = Trails(np.array(passed), {name: np.array(path) for name, path in paths.items()})
    look = PLANE if run.scene.dim == 2 else view(run.scene, box, wanted.view or "iso")
    dots = Dots.of(rest, frames.bodies)
    suffix = "" if frames.complete else ": as far as it is written"
    quantity, scheme = colours(wanted.color, run, frames, shown)
    ropes = cables(run, frames)
    marked = goals(run.scene, frames.provenance)
    corners = seen(_plane(frames, shown, look, trails), look, marked, dots.size)
    name = f"{run.name}{suffix}"
    return Stage(run.scene, look, corners, box, dots, scheme, trails, ropes, marked, name, quantity)


def cables(run: RunData, frames: Frames) -> list[Array]:
    """Return the particles along each cable of the scene, in order."""
    if not any(isinstance(chosen.value, Cable) for chosen in run.scene.actuators.values()):
        return []
    actuation = Assembly(run.scene, sampled(run, frames)).actuation
    return [part.model.particles for part in actuation.parts if isinstance(part.spec, Cable)]


def _plane(frames: Frames, shown: Sequence[int], look: View, trails: Trails) -> Array:
    """Return points in the plane of a view (n, 2) [m], as far out as particles of the frames shown and trails come."""
    ends = [path @ look.axes.T for path in trails.paths.values()]
    for frame in shown:
        plane = frames.read("x", frame) @ look.axes.T
        ends.append(np.array([plane.min(axis=0), plane.max(axis=0)]))
    return np.concatenate(ends)


def followed_particles(run: RunData, frames: Frames, trail: str | None) -> dict[str, Array]:
    """Return the particles whose centroid leaves a trail, by name.

    Raises:
        UsageError: nothing is called so.
    """
    bodies = {name: np.arange(part.start, part.stop) for name, part in frames.bodies.items()}
    if trail is None:
        return bodies
    if trail == NO_TRAIL:
        return {}
    if trail in bodies:
        return {trail: bodies[trail]}
    particles = sampled(run, frames)
    groups = {f"{body}.{name}": held for body in particles.names for name, held in particles.groups(body).items()}
    matching = [name for name in groups if trail in (name, name.partition(".")[2])]
    if len(matching) == 1 and len(groups[matching[0]]):
        return {matching[0]: groups[matching[0]]}
    names = [*bodies, *groups]
    if matching and len(matching) > 1:
        raise UsageError(f"--trail {trail}: several groups are called so: {listed(matching)}; name one of them")
    near = suggest(trail, names)
    raise UsageError(f"--trail {trail}: no body or group is called so{near}; there are: {listed(names)}, {NO_TRAIL}")


# --- drawing ------------------------------------------------------------------------------------------------


def _draw(
    stage: Stage, frames: Frames, shown: Sequence[int], wanted: Wanted, output: Path, talk: Reporter
) -> list[Path]:
    movie = wanted.kind in ("gif", "mp4")
    layers = len(shown) if wanted.kind == "onion" else 1
    with Picture(stage, layers, MOVIE_DPI if movie else STILL_DPI) as picture:
        if wanted.kind == "onion":
            write_png(output, _onion(picture, frames, shown), STILL_DPI)
            return [output]
        if not movie:
            return _stills(picture, frames, shown, output, talk)
        talk.phase(f"drawing {len(shown)} pictures")
        pictures = _pictures(picture, frames, shown, talk)
        if wanted.kind == "mp4":
            write_mp4(output, pictures, wanted.fps)
            return [output]
        if not np.isclose(wanted.fps * gif_delay(wanted.fps), 1000.0):
            talk.warn(
                f"pictures of a GIF last whole hundredths of a second: {1000 / gif_delay(wanted.fps):.3g} a second "
                f"instead of {wanted.fps:g}"
            )
        spread = np.unique(np.linspace(0, len(shown) - 1, SAMPLES).astype(int))
        samples = [_frame(picture, frames, shown, int(k)) for k in spread]
        write_gif(output, pictures, wanted.fps, samples)
        return [output]


def _pictures(picture: Picture, frames: Frames, shown: Sequence[int], talk: Reporter) -> Iterator[Array]:
    """Yield the pictures of the frames shown.

    Raises:
        Stopped: it was asked to stop.
    """
    for place in range(len(shown)):
        if talk.stop.asked:
            raise talk.stop.stopped("stopped; no picture was written")
        yield _frame(picture, frames, shown, place)
        talk.advance(place + 1, len(shown), f"picture {place + 1} of {len(shown)}")


def _frame(picture: Picture, frames: Frames, shown: Sequence[int], place: int) -> Array:
    frame = shown[place]
    layer = frames.read("x", frame), picture.stage.colours.rgb(frame)
    return picture.show([layer], f"t = {stamp(frames, frame)} s", frame)


def _stills(picture: Picture, frames: Frames, shown: Sequence[int], output: Path, talk: Reporter) -> list[Path]:
    written = []
    for place, pixels in enumerate(_pictures(picture, frames, shown, talk), 1):
        number = f"_{place:0{len(str(len(shown)))}}" if len(shown) > 1 else ""
        written.append(output.with_name(f"{output.stem}{number}{output.suffix}"))
        write_png(written[-1], pixels, STILL_DPI)
    return written


def _onion(picture: Picture, frames: Frames, shown: Sequence[int]) -> Array:
    """Return several instants in one picture, the earlier the paler."""
    paleness = np.linspace(PALEST, 0.0, len(shown)) if len(shown) > 1 else [0.0]
    layers = [
        (frames.read("x", frame), picture.stage.colours.rgb(frame, float(pale)))
        for frame, pale in zip(shown, paleness, strict=True)
    ]
    times = [stamp(frames, frame) for frame in shown]
    told = ", ".join(times) if len(times) <= MOST_TIMES else f"{times[0]}, {times[1]}, ..., {times[-1]}"
    return picture.show(layers, f"t = {told} s", shown[-1])


def stamp(frames: Frames, frame: int) -> str:
    """Return the time of a frame with as many digits as tell frames apart."""
    steps = np.diff(frames.time)
    digits = int(np.clip(np.ceil(-np.log10(steps[steps > 0].min()) - 1e-9), 0, 9)) if (steps > 0).any() else 3
    return f"{frames.time[frame]:.{digits}f}"

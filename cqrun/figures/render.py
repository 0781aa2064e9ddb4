"""Make movies and stills of a run's trajectory for `cqrun render`, reading and drawing one frame at a time."""

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
from cqrun.figures.rigid import extent_of
from cqrun.figures.run_data import TRAJECTORY, RunData, read_run
from cqrun.figures.scenery import goals, window_with_goals
from cqrun.figures.solid import require_pyvista
from cqrun.figures.style import styled
from cqrun.figures.views import PLANE, View, view
from cqrun.objectives.reach import Reach
from cqrun.objectives.track import Tracking
from cqrun.plugin.contract import Array
from cqrun.running.reporter import Reporter, Silent
from cqrun.scene.schema import Scene
from cqrun.store.atomic import make_directory
from cqrun.store.folder import FIGURES, make_below
from cqrun.store.frames import Frames

MOVIE_DPI, STILL_DPI = 110.0, 220.0

PALEST = 0.78
"""Share of white in the colours of the first of several instants in one picture."""

SAMPLES = 5
"""Number of pictures from which the palette of a GIF is made."""

MOST_TIMES = 6
"""Largest number of instants whose times are all in the title."""

NO_TRAIL = "none"


@dataclass(frozen=True)
class RenderOptions:
    """Options of the drawing.

    Attributes:
        kind: a movie (gif, mp4), the last frame (png), several pictures (stills), or several instants in one (onion).
        count: number of stills or instants.
        color: one of `choices.Quantity`; a default for the run if None.
        fps: pictures per second of a movie.
        every: use only every n-th frame of the trajectory.
        view: one of `choices.Look`, for 3D; iso if None.
        trail: body, group or body.group whose path is drawn; if None, the groups that should reach or follow something,
            and all bodies without such a group; no path if `none`.
        output: file to write; a file in `figures/` of the run if None.
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
        return "a learned motion is written at the end; `cqrun simulate RUN` runs the best controller so far"
    return "nothing to draw before the first frame"


def render(path: Path, options: RenderOptions, reporter: Reporter | None = None) -> list[Path]:
    """Draw the frames of a run that are written so far; return the paths of the files.

    Raises:
        UsageError: the path is not a run or has no frames, or the requested picture is not possible.
        MissingExtra: pyvista or ffmpeg is needed but not installed.
        Stopped: it was asked to stop; no file is left behind.
        RunError: the disk is full.
    """
    reporter = reporter or Silent()
    run = read_run(path)
    if not run.has_trajectory():
        raise UsageError(f"{path}: there is no {TRAJECTORY}: {_no_frames(run)}")
    if options.kind == "mp4":
        ffmpeg()
    if run.scene.dim == 3:
        require_pyvista()
    with Frames(path / TRAJECTORY) as frames, styled():
        shown = shown_frames(len(frames), options)
        reporter.phase(f"reading {len(shown)} of {len(frames)} frames")
        stage = set_stage(run, frames, shown, options)
        output = options.output or make_below(path, FIGURES) / _name(options, stage)
        make_directory(output.parent)
        return _draw(stage, frames, shown, options, output, reporter)


def shown_frames(count: int, options: RenderOptions) -> list[int]:
    """Return the frames to draw: the last one, several that are spread over the time, or every n-th.

    Raises:
        UsageError: there are too few frames.
    """
    if count == 0:
        raise UsageError(f"{TRAJECTORY}: no frame in it yet, so there is nothing to draw")
    every = list(range(0, count, options.every))
    if options.kind in ("gif", "mp4"):
        return every
    if options.kind == "png":
        return [count - 1]
    if options.count > count:
        raise UsageError(f"--{options.kind} {options.count}: the trajectory has only {count} frames")
    return [int(k) for k in np.round(np.linspace(0, count - 1, options.count))]


def _name(options: RenderOptions, stage: Stage) -> str:
    what = {"gif": "motion", "mp4": "motion", "png": "last", "stills": "still", "onion": "onion"}[options.kind]
    suffix = options.kind if options.kind in ("gif", "mp4") else "png"
    return f"{what}_{stage.quantity}.{suffix}"


# --- the stage ----------------------------------------------------------------------------------------------


def set_stage(run: RunData, frames: Frames, shown: Sequence[int], options: RenderOptions) -> Stage:
    """Return the parts that are the same in all pictures; reads all frames shown, one at a time."""
    rest = frames.read("x", 0)
    if run.scene.dim == 2 and options.view is not None:
        view(run.scene, rest, options.view)  # raises the error that 2D has no views
    box = np.array([rest.min(axis=0), rest.max(axis=0)])
    followed = followed_particles(run, frames, options.trail)
    visited = range(0, shown[-1] + 1, options.every)
    paths: dict[str, list[Array]] = {name: [] for name in followed}
    for frame in visited:
        x = frames.read("x", frame)
        box = np.array([np.minimum(box[0], x.min(axis=0)), np.maximum(box[1], x.max(axis=0))])
        for name, particles in followed.items():
            paths[name].append(x[particles].mean(axis=0))
    trails = Trails(np.array(visited), {name: np.array(path) for name, path in paths.items()})
    look = PLANE if run.scene.dim == 2 else view(run.scene, box, options.view or "iso")
    dots = Dots.of(rest, frames.bodies)
    suffix = "" if frames.complete else ": not complete yet"
    quantity, scheme = colours(options.color, run, frames)
    routes = cables(run, frames)
    marked = goals(run.scene, frames.provenance)
    rigid, steps = frames.read_rigid(), [int(step) for step in frames.step]
    plane = [_extent(frames, shown, look, trails), extent_of(run.scene, rigid, [steps[k] for k in shown], look)]
    corners = window_with_goals(np.concatenate(plane), look, marked, dots.size)
    name = f"{run.name}{suffix}"
    return Stage(
        run.scene, look, corners, box, dots, scheme, trails, routes, marked, name, quantity, rigid, steps
    )  # fmt: skip


def cables(run: RunData, frames: Frames) -> list[Array]:
    """Return the particles along each cable of the scene, in order."""
    if not any(isinstance(chosen.value, Cable) for chosen in run.scene.actuators.values()):
        return []
    actuation = Assembly(run.scene, sampled(run, frames)).actuation
    routes = []
    for part in actuation.parts:
        if isinstance(part.spec, Cable):
            lines = part.spec.lines(part.model.constants, len(part.model.particles))
            ends = np.cumsum([line.points for line in lines])[:-1]
            routes += [route[route >= 0] for route in np.split(part.model.particles, ends)]
    return routes


def _extent(frames: Frames, shown: Sequence[int], look: View, trails: Trails) -> Array:
    """Return points in the plane of a view (n, 2) [m] with the same extent as the frames shown and the trails."""
    ends = [path @ look.axes.T for path in trails.paths.values()]
    for frame in shown:
        plane = frames.read("x", frame) @ look.axes.T
        ends.append(np.array([plane.min(axis=0), plane.max(axis=0)]))
    return np.concatenate(ends)


def aimed_groups(scene: Scene) -> list[tuple[str, str]]:
    """Return body and group of every term of the objective or constraint that a group reach or follow something."""
    terms = [chosen.value for chosen in scene.objective.values()]
    terms += [constraint.of.value for constraint in scene.constraints.values()]
    aimed = [
        (term.body, term.group) for term in terms if isinstance(term, (Reach, Tracking)) and term.group is not None
    ]
    return list(dict.fromkeys(aimed))


def followed_particles(run: RunData, frames: Frames, trail: str | None) -> dict[str, Array]:
    """Return the particles whose centroid leaves a trail, by name.

    Raises:
        UsageError: no body or group has this name.
    """
    bodies = {name: np.arange(part.start, part.stop) for name, part in frames.bodies.items()}
    if trail == NO_TRAIL:
        return {}
    if trail is not None and trail in bodies:
        return {trail: bodies[trail]}
    aimed = aimed_groups(run.scene)
    if trail is None and not aimed:
        return bodies
    particles = sampled(run, frames)
    if trail is None:
        found: dict[str, Array] = {}
        for name, members in bodies.items():
            inner = {f"{name}.{g}": particles.groups(name)[g] for b, g in aimed if b == name}
            found |= inner or {name: members}
        return found
    groups = {f"{body}.{name}": indices for body in particles.names for name, indices in particles.groups(body).items()}
    matching = [name for name in groups if trail in (name, name.partition(".")[2])]
    if len(matching) == 1 and len(groups[matching[0]]):
        return {matching[0]: groups[matching[0]]}
    names = [*bodies, *groups]
    if matching and len(matching) > 1:
        raise UsageError(f"--trail {trail}: several groups have this name: {listed(matching)}; give one of these")
    near = suggest(trail, names)
    raise UsageError(f"--trail {trail}: no body or group has this name{near}; there are: {listed(names)}, {NO_TRAIL}")


# --- drawing ------------------------------------------------------------------------------------------------


def _draw(
    stage: Stage, frames: Frames, shown: Sequence[int], options: RenderOptions, output: Path, reporter: Reporter
) -> list[Path]:
    movie = options.kind in ("gif", "mp4")
    layers = len(shown) if options.kind == "onion" else 1
    with Picture(stage, layers, MOVIE_DPI if movie else STILL_DPI) as picture:
        if options.kind == "onion":
            write_png(output, _onion(picture, frames, shown), STILL_DPI)
            return [output]
        if not movie:
            return _stills(picture, frames, shown, output, reporter)
        reporter.phase(f"drawing {len(shown)} pictures")
        pictures = _pictures(picture, frames, shown, reporter)
        if options.kind == "mp4":
            write_mp4(output, pictures, options.fps)
            return [output]
        if not np.isclose(options.fps * gif_delay(options.fps), 1000.0):
            reporter.warn(
                f"pictures of a GIF last whole hundredths of a second: {1000 / gif_delay(options.fps):.3g} per second "
                f"instead of {options.fps:g}"
            )
        spread = np.unique(np.linspace(0, len(shown) - 1, SAMPLES).astype(int))
        samples = [_frame(picture, frames, shown, int(k)) for k in spread]
        write_gif(output, pictures, options.fps, samples)
        return [output]


def _pictures(picture: Picture, frames: Frames, shown: Sequence[int], reporter: Reporter) -> Iterator[Array]:
    """Yield the pictures of the frames shown.

    Raises:
        Stopped: it was asked to stop.
    """
    for place in range(len(shown)):
        if reporter.stop.asked:
            raise reporter.stop.stopped("stopped; no picture was written")
        yield _frame(picture, frames, shown, place)
        reporter.advance(place + 1, len(shown), f"picture {place + 1} of {len(shown)}")


def _frame(picture: Picture, frames: Frames, shown: Sequence[int], place: int) -> Array:
    frame = shown[place]
    layer = frames.read("x", frame), picture.stage.colours.rgb(frame)
    return picture.show([layer], f"t = {stamp(frames, frame)} s", frame)


def _stills(picture: Picture, frames: Frames, shown: Sequence[int], output: Path, reporter: Reporter) -> list[Path]:
    written = []
    for place, pixels in enumerate(_pictures(picture, frames, shown, reporter), 1):
        number = f"_{place:0{len(str(len(shown)))}}" if len(shown) > 1 else ""
        written.append(output.with_name(f"{output.stem}{number}{output.suffix}"))
        write_png(written[-1], pixels, STILL_DPI)
    return written


def _onion(picture: Picture, frames: Frames, shown: Sequence[int]) -> Array:
    """Return several instants in one picture; earlier ones are paler."""
    paleness = np.linspace(PALEST, 0.0, len(shown)) if len(shown) > 1 else [0.0]
    layers = [
        (frames.read("x", frame), picture.stage.colours.rgb(frame, float(pale)))
        for frame, pale in zip(shown, paleness, strict=True)
    ]
    times = [stamp(frames, frame) for frame in shown]
    text = ", ".join(times) if len(times) <= MOST_TIMES else f"{times[0]}, {times[1]}, ..., {times[-1]}"
    return picture.show(layers, f"t = {text} s", shown[-1])


def stamp(frames: Frames, frame: int) -> str:
    """Return the time of a frame as text, with enough digits to distinguish the frames."""
    steps = np.diff(frames.time)
    digits = int(np.clip(np.ceil(-np.log10(steps[steps > 0].min()) - 1e-9), 0, 9)) if (steps > 0).any() else 3
    return f"{frames.time[frame]:.{digits}f}"

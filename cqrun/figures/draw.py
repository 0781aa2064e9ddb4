"""Draw the pictures of a run into its figures/ folder, and compare several runs in one picture."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cqrun.errors import UsageError
from cqrun.figures.bodies import draw_bodies
from cqrun.figures.compare import draw_comparison
from cqrun.figures.convergence import draw_convergence
from cqrun.figures.design import designed_quantities, draw_design, draw_shape, has_new_shape
from cqrun.figures.losses import LOSS
from cqrun.figures.measured import draw_measured, has_measured
from cqrun.figures.overlay import FORWARD, draw_overlay
from cqrun.figures.overview import draw_overview
from cqrun.figures.path import draw_path, has_path
from cqrun.figures.reactions import draw_reactions, has_reactions
from cqrun.figures.rest import draw_rest
from cqrun.figures.run_data import HISTORY, TRAJECTORY, RunData, read_run
from cqrun.figures.style import save, styled
from cqrun.figures.tracks import draw_recording
from cqrun.jobs.table import JOBS, job_of
from cqrun.store.atomic import make_directory
from cqrun.store.folder import FIGURES, make_below
from cqrun.store.result import RESULT, SysidResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Picture = tuple[str, Callable[[], "Figure"]]
"""A picture: the name of its file without suffix, and a function that draws it."""

MOST_NAMES = 5
"""Largest number of scenes in the name of a comparison."""

INCOMPLETE = "although the run has finished: the directory is incomplete, run its scene again with --fresh"


def draw_run(path: Path, kinds: Sequence[str] = ("png",), folder: Path | None = None) -> list[Path]:
    """Draw everything that a run has so far; return the paths of the pictures.

    convergence   loss and unknowns against the iteration
    tracks_NAME   a recording beside the model
    path          displacements and reactions along a path of equilibria
    measured      quantities that the scene measures, over time
    reactions     force and moment of boundaries over time
    bodies        first, middle and last frame of the trajectory
    design        designed quantities of the material, on the body
    shape         the body before and after the design
    overview      the most important panels in one wide picture

    Args:
        path: the run directory.
        kinds: png, pdf.
        folder: where the pictures go; the folder figures/ of the run if not given.

    Raises:
        UsageError: the path is not a run, a file is missing or damaged, or there is nothing to draw yet.
        RunError: the disk is full.
    """
    run = read_run(path)
    require_files(run)
    figures = make_below(path, FIGURES) if folder is None else folder
    written: list[Path] = []
    with styled():
        for name, draw in _figures(run):
            written += save(draw(), figures / name, kinds)
    return written


def pictures_of(path: Path) -> list[Path]:
    """Return the pictures that `draw_run` makes of a run, whether they are there or not.

    Raises:
        UsageError: the path is not a run, or a file is missing or damaged.
    """
    run = read_run(path)
    require_files(run)
    return [path / FIGURES / f"{name}.png" for name, _ in _figures(run)]


def require_files(run: RunData) -> None:
    """Raise a UsageError if a run lacks files that are needed to draw it."""
    if not job_of(run.path).pictures:
        *most, last = (name for name, job in JOBS.items() if job.pictures)
        drawn = f"{', '.join(most)} and {last}"
        raise UsageError(f"{run.path}: a run of '{run.job}' has no pictures; runs of {drawn} have them")
    if run.job not in ("simulate", "rest"):
        if not run.scene.predicts_only:
            run.require(HISTORY, "so there is no convergence to draw")
            if not run.history:
                raise UsageError(f"{run.path}: {HISTORY} has no rows yet: nothing to draw before the first iteration")
        if run.succeeded:
            run.require(RESULT, INCOMPLETE)
        if run.succeeded and run.job == "sysid":
            run.require(TRAJECTORY, INCOMPLETE)
            if isinstance(run.result, SysidResult) and run.result.recordings:
                run.require_tables(INCOMPLETE)
    elif not run.has_trajectory():
        raise UsageError(f"{run.path}: there is no {TRAJECTORY}: nothing to draw before the first frame")


def _figures(run: RunData) -> list[Picture]:
    """Return everything that can be drawn of a run, of the pictures of its job."""
    return [drawn for picture in job_of(run.path).pictures for drawn in PICTURES[picture](run)]


def _convergence(run: RunData) -> Iterator[Picture]:
    if run.history:
        yield "convergence", partial(draw_convergence, run)


def _tracks(run: RunData) -> Iterator[Picture]:
    if run.has_tables():
        for tracks in run.tracks():
            draw = draw_rest if tracks.at_rest else draw_recording
            yield f"tracks_{tracks.recording}", partial(draw, tracks, run.name)


def _bodies(run: RunData) -> Iterator[Picture]:
    if run.has_trajectory():
        yield "bodies", partial(draw_bodies, run)


def _design(run: RunData) -> Iterator[Picture]:
    if run.has_trajectory() and (shown := designed_quantities(run)):
        yield "design", partial(draw_design, run, shown)


def _shape(run: RunData) -> Iterator[Picture]:
    if run.has_trajectory() and has_new_shape(run):
        yield "shape", partial(draw_shape, run)


def _path(run: RunData) -> Iterator[Picture]:
    if has_path(run):
        yield "path", partial(draw_path, run)


def _reactions(run: RunData) -> Iterator[Picture]:
    if has_reactions(run):
        yield "reactions", partial(draw_reactions, run)


def _measured(run: RunData) -> Iterator[Picture]:
    if has_measured(run):
        yield "measured", partial(draw_measured, run)


def _overview(run: RunData) -> Iterator[Picture]:
    if run.succeeded and (run.history or run.scene.predicts_only):
        yield "overview", partial(draw_overview, run)


PICTURES: dict[str, Callable[[RunData], Iterator[Picture]]] = {
    "convergence": _convergence,
    "tracks": _tracks,
    "bodies": _bodies,
    "design": _design,
    "shape": _shape,
    "overview": _overview,
    "path": _path,
    "reactions": _reactions,
    "measured": _measured,
}
"""Pictures by the names that jobs give them; each yields those of which a run has what they show."""


def draw_several(
    paths: Sequence[Path], out: Path, kinds: Sequence[str] = ("png",), term: str | None = None
) -> list[Path]:
    """Compare runs in one picture, `out`/compare_<scenes>; return its paths.

    If a picture of other runs has this name, the name of the new one ends in a hash of its runs.

    Args:
        paths: the run directories.
        out: directory of the picture.
        kinds: png, pdf.
        term: the term of the objective to compare; the loss if None or `loss`. Of simulations and equilibria, the
            measured quantity to compare; all if None.

    Raises:
        UsageError: a directory is not a run or has no history yet, or the losses of the runs are of different kinds.
        RunError: the disk is full.
    """
    term = None if term == LOSS else term
    runs = [read_run(path) for path in paths]
    names = list(dict.fromkeys(run.name for run in runs))
    words = [*names[:MOST_NAMES], *(["others"] if len(names) > MOST_NAMES else []), *([] if term is None else [term])]
    base, identity = out / f"compare_{'_'.join(words)}", fingerprint(runs)
    if any(shows_other_runs(base.with_name(f"{base.name}.{kind}"), identity) for kind in kinds):
        base = base.with_name(f"{base.name}_{identity[:8]}")
    make_directory(out)
    draw = draw_overlay if any(run.job in FORWARD and not run.history for run in runs) else draw_comparison
    with styled():
        return save(draw(runs, term), base, kinds, keywords=identity)


def fingerprint(runs: Sequence[RunData]) -> str:
    """Return hex digits that identify a set of runs, independent of their order and location."""
    names = sorted(f"{run.name}/{run.path.resolve().name}" for run in runs)
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:32]


def shows_other_runs(picture: Path, identity: str) -> bool:
    """Return whether a picture exists that does not have these runs' fingerprint among its keywords."""
    return picture.is_file() and identity.encode() not in picture.read_bytes()

"""Draw what a run directory holds, into its own figures/; several runs are compared elsewhere."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cqrun.errors import UsageError
from cqrun.figures.bodies import draw_bodies
from cqrun.figures.compare import draw_comparison
from cqrun.figures.convergence import draw_convergence
from cqrun.figures.design import designed_quantities, draw_design, draw_shape, has_new_shape
from cqrun.figures.losses import LOSS
from cqrun.figures.overview import draw_overview
from cqrun.figures.run_data import HISTORY, TRACKS, TRAJECTORY, RunData, read_run
from cqrun.figures.style import save, styled
from cqrun.figures.tracks import draw_recording
from cqrun.jobs.table import JOBS, job_of
from cqrun.store.atomic import make_directory
from cqrun.store.result import RESULT, SysidResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = "figures"

MOST_NAMES = 5
"""Scenes that the name of a comparison tells."""

INCOMPLETE = "though the run has ended well: the directory is incomplete, run its scene again with --fresh"


def has_pictures(path: Path) -> bool:
    """Say whether the job of a run is one that is drawn; UsageError if it is no run."""
    return bool(job_of(path).pictures)


def draw_run(path: Path, kinds: Sequence[str] = ("png",)) -> list[Path]:
    """Draw all that a run has so far; return the pictures' paths.

    convergence   loss and unknowns against the iteration
    tracks_NAME   markers of a recording beside the model
    bodies        first, middle and last frame of the trajectory
    design        what of the material was designed, on the body
    shape         the body before and as it was designed
    overview      the most of it in one wide picture

    Args:
        path: the run's directory.
        kinds: png, pdf.

    Raises:
        UsageError: it is no run, what it should hold is missing or damaged, or nothing is there to draw yet.
        RunError: the disk is full.
    """
    run = read_run(path)
    require_files(run)
    figures = path / FIGURES
    make_directory(figures)
    written: list[Path] = []
    with styled():
        for name, figure in _figures(run):
            written += save(figure, figures / name, kinds)
    return written


def require_files(run: RunData) -> None:
    """Raise a UsageError where a run lacks what there must be to draw it."""
    if not job_of(run.path).pictures:
        *most, last = (name for name, job in JOBS.items() if job.pictures)
        raise UsageError(
            f"{run.path}: a run of '{run.job}' has no pictures; those of {', '.join(most)} and {last} have"
        )
    if run.job != "simulate":
        run.require(HISTORY, "so there is no convergence to draw")
        if not run.history:
            raise UsageError(f"{run.path}: {HISTORY} has no rows yet: nothing to draw before the first iteration")
        if run.succeeded:
            run.require(RESULT, INCOMPLETE)
        if run.succeeded and run.job == "sysid":
            run.require(TRAJECTORY, INCOMPLETE)
            if isinstance(run.result, SysidResult) and run.result.recordings:
                run.require(TRACKS, INCOMPLETE)
    elif not run.has_trajectory():
        raise UsageError(f"{run.path}: there is no {TRAJECTORY}: nothing to draw before the first frame")


def _figures(run: RunData) -> list[tuple[str, Figure]]:
    """Return name and picture of all that a run has, of those that its job has."""
    return [drawn for picture in job_of(run.path).pictures for drawn in PICTURES[picture](run)]


def _convergence(run: RunData) -> Iterator[tuple[str, Figure]]:
    if run.history:
        yield "convergence", draw_convergence(run)


def _tracks(run: RunData) -> Iterator[tuple[str, Figure]]:
    if run.has(TRACKS):
        yield from ((f"tracks_{tracks.recording}", draw_recording(tracks, run.name)) for tracks in run.tracks())


def _bodies(run: RunData) -> Iterator[tuple[str, Figure]]:
    if run.has_trajectory():
        yield "bodies", draw_bodies(run)


def _design(run: RunData) -> Iterator[tuple[str, Figure]]:
    if run.has_trajectory() and (shown := designed_quantities(run)):
        yield "design", draw_design(run, shown)


def _shape(run: RunData) -> Iterator[tuple[str, Figure]]:
    if run.has_trajectory() and has_new_shape(run):
        yield "shape", draw_shape(run)


def _overview(run: RunData) -> Iterator[tuple[str, Figure]]:
    if run.history and run.succeeded:
        yield "overview", draw_overview(run)


PICTURES: dict[str, Callable[[RunData], Iterator[tuple[str, Figure]]]] = {
    "convergence": _convergence,
    "tracks": _tracks,
    "bodies": _bodies,
    "design": _design,
    "shape": _shape,
    "overview": _overview,
}
"""Pictures by the names that jobs give them; each yields name and picture where a run has what it shows."""


def draw_several(
    paths: Sequence[Path], out: Path, kinds: Sequence[str] = ("png",), term: str | None = None
) -> list[Path]:
    """Compare runs in one picture, `out`/compare_<scenes>; return its paths.

    Where a picture of other runs has this name, the name of the new one ends in a hash of its runs.

    Args:
        paths: of the runs.
        out: directory of the picture.
        kinds: png, pdf.
        term: of the objective that is compared; the loss if None or `loss`.

    Raises:
        UsageError: a directory is no run, has no history yet, or the runs' losses are of different kinds.
        RunError: the disk is full.
    """
    term = None if term == LOSS else term
    runs = [read_run(path) for path in paths]
    names = list(dict.fromkeys(run.name for run in runs))
    told = [*names[:MOST_NAMES], *(["others"] if len(names) > MOST_NAMES else []), *([] if term is None else [term])]
    base, shows = out / f"compare_{'_'.join(told)}", fingerprint(runs)
    if any(is_of_others(base.with_name(f"{base.name}.{kind}"), shows) for kind in kinds):
        base = base.with_name(f"{base.name}_{shows[:8]}")
    make_directory(out)
    with styled():
        return save(draw_comparison(runs, term), base, kinds, keywords=shows)


def fingerprint(runs: Sequence[RunData]) -> str:
    """Return hex digits that tell which runs these are, in whatever order and wherever they lie."""
    names = sorted(f"{run.name}/{run.path.resolve().name}" for run in runs)
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:32]


def is_of_others(picture: Path, shows: str) -> bool:
    """Say whether there is a picture that does not say, among its keywords, that it shows these runs."""
    return picture.is_file() and shows.encode() not in picture.read_bytes()

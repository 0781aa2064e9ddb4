"""A small film of a run's motion, for its report."""

from __future__ import annotations

from pathlib import Path

from cqrun.errors import MissingExtra
from cqrun.figures.render import RenderOptions, render
from cqrun.figures.run_data import RunData
from cqrun.report.subject import Film
from cqrun.running.cost import film_step

FEWEST = 3
"""A run with fewer frames has no film."""

MOST_BYTES = 1_500_000
"""A larger film is made again with fewer pictures."""

FPS, FPS_AT_REST = 12.5, 4.0
"""Pictures per second: of a motion, and of a path of equilibria. A picture lasts whole hundredths of a second."""


def make_film(run: RunData, folder: Path) -> Film | None:
    """Draw a film of a run into a folder; return None if the run has no motion.

    Raises:
        UsageError: the trajectory is damaged.
    """
    if not run.has_trajectory():
        return None
    with run.frames() as frames:
        count, times = len(frames), frames.time
        particles = max(part.stop for part in frames.bodies.values())
    if count < FEWEST:
        return None
    fps = FPS_AT_REST if run.job == "rest" else FPS
    path = folder / "film.gif"
    fewest = film_step(count, particles)
    for every in (fewest, 2 * fewest, 4 * fewest):
        try:
            render(run.path, RenderOptions(fps=fps, every=every, output=path))
        except MissingExtra as missing:
            return Film(why=str(missing))
        if path.stat().st_size <= MOST_BYTES:
            shown = range(0, count, every)
            first, last = float(times[0]), float(times[shown[-1]])
            speed = (last - first) / ((len(shown) - 1) / fps) if len(shown) > 1 else 1.0
            return Film(path, first, last, len(shown), speed)
    return None

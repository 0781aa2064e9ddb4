"""What a scene needs more memory for than there is: told before a run, with what would be right."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cqrun.engine.setting import grid_shape
from cqrun.errors import Problem
from cqrun.build.particles import Particles
from cqrun.scene.schema import Scene
from cqrun.units import format_bytes

DOUBLE = 8
"""Bytes of a float64."""


def memory_problems(scene: Scene, particles: Particles) -> list[Problem]:
    """Return what of a scene does not fit the memory that is free."""
    import psutil

    there = psutil.virtual_memory().available
    free = f"{format_bytes(there)} are free"
    return [
        Problem(scene.where(path), path, f"{what} need {format_bytes(int(need))}; {free}: {advice}")
        for path, what, need, advice in _needs(scene, particles)
        if need > there
    ]


def _needs(scene: Scene, particles: Particles) -> Iterator[tuple[str, str, float, str]]:
    """Yield (key path, what, bytes, advice)."""
    nodes = float(np.prod(grid_shape(np.array(scene.world.size), scene.world.dx)))
    itemsize = np.dtype(scene.precision).itemsize
    working = nodes * (3 * 4 * itemsize + 8) + particles.layout.n * (100 + 4 * scene.dim**2) * itemsize
    what = f"{nodes:.3g} grid nodes and {particles.layout.n_particles} particles"
    yield "world", what, working, "use a larger dx or a smaller world"
    # at every control step, were it of one marker, and of every actuator
    steps = float(scene.time.control_steps)
    records = DOUBLE * steps * (particles.layout.table.n_rows + len(scene.actuators))
    what = f"the records of {steps:.3g} control steps"
    yield "time.duration", what, records, "use fewer: longer ones, or a shorter run"
    made = scene.synthetic
    if made is not None:
        frames = made.key_frames or steps // (made.every or 1) + 1
        points = made.tracked or len(made.markers or {})
        recordings = made.copies * scene.sequences
        size = DOUBLE * recordings * frames * points * scene.dim
        yield "data.synthetic.copies", f"{recordings:,} recordings", size, "make fewer copies"

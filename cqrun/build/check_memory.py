"""Check before a run that a scene fits the free memory; the problems say what would be right."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cqrun.build.particles import Particles
from cqrun.engine.setting import grid_shape
from cqrun.errors import Problem
from cqrun.scene.schema import Scene
from cqrun.units import format_bytes

DOUBLE = 8
"""Size of a float64 [bytes]."""


def memory_problems(scene: Scene, particles: Particles) -> list[Problem]:
    """Return the parts of a scene that need more memory than is free."""
    import psutil

    available = psutil.virtual_memory().available
    free = f"{format_bytes(available)} are free"
    return [
        Problem(scene.where(path), path, f"{what} need {format_bytes(int(need))}; {free}: {advice}")
        for path, what, need, advice in _needs(scene, particles)
        if need > available
    ]


def _needs(scene: Scene, particles: Particles) -> Iterator[tuple[str, str, float, str]]:
    """Yield (key path, what needs memory, bytes, advice)."""
    nodes = float(np.prod(grid_shape(np.array(scene.world.size), scene.world.dx)))
    itemsize = np.dtype(scene.precision).itemsize
    working = nodes * (3 * 4 * itemsize + 8) + particles.layout.n * (100 + 4 * scene.dim**2) * itemsize
    what = f"{nodes:.3g} grid nodes and {particles.layout.n_particles} particles"
    yield "world", what, working, "use a larger dx or a smaller world"
    # per control step at least one marker, and every actuator
    steps = float(scene.time.control_steps)
    records = DOUBLE * steps * (particles.layout.table.n_rows + len(scene.actuators))
    what = f"the records of {steps:.3g} control steps"
    yield "time.duration", what, records, "use fewer control steps, with longer ones or a shorter run"
    synthetic = scene.synthetic
    if synthetic is not None:
        frames = synthetic.key_frames or steps // (synthetic.every or 1) + 1
        points = synthetic.tracked or len(synthetic.markers or {})
        recordings = synthetic.copies * scene.sequences
        size = DOUBLE * recordings * frames * points * scene.dim
        yield "data.synthetic.copies", f"{recordings:,} recordings", size, "make fewer copies"

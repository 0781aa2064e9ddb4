"""Artificial runs whose particles move, for tests of films."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_runs import plane_scene, write_run

from cqrun.build.particles import sample
from cqrun.figures.run_data import TRAJECTORY, read_run
from cqrun.store.trajectory import TrajectoryWriter

LEFT = {"box": {"corner": [0, 0], "size": [0.045, 0.1]}}
MUSCLE = {"muscle": {"body": "a", "region": LEFT, "axis": [1, 0], "strength": 1}}


def moving(out: Path, scene: dict, *, frames: int = 4, dim: int = 2, field_v: bool = True) -> Path:
    """Return a run whose particles move to the right by 1 mm per frame."""
    run = write_run(out, scene, job="simulate", status="done")
    particles = sample(read_run(run).scene)
    bodies = {name: particles.of(name) for name in particles.names}
    fields = {"v": (dim,)} if field_v else {}
    with TrajectoryWriter(run / TRAJECTORY, frames, bodies, dim, fields, {}) as writer:
        for k in range(frames):
            x = particles.x.copy()
            x[:, 0] += 1e-3 * k
            extra = {"v": np.full_like(x, 0.3)} if field_v else {}
            writer.write(k, 0.1 * k, x=x, step=np.asarray(10 * k), **extra)
    return run


def pulled(out: Path) -> Path:
    """Return a run of two bodies, of which a muscle pulls one, and a goal."""
    signals, target = {"signals": {"pull": [0.25, -0.5]}}, {"target": {"position": [0.19, 0.09]}}
    return moving(out, plane_scene({}, actuators={"pull": MUSCLE}, activation=signals, goals=target))

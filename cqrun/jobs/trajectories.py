"""One forward run of a scene into a trajectory file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from cqrun.contract import Array
from cqrun.engine.model import Records
from cqrun.engine.rollout import Rollout
from cqrun.fingerprint import engine_hash
from cqrun.scene.build import Built
from cqrun.scene.load import dump, resolve
from cqrun.state import State
from cqrun.store.trajectory import TrajectoryWriter

FRAMES = 300
"""Frames after the first that a trajectory has at the most, spread evenly over the control steps."""


def write_trajectory(
    path: Path,
    built: Built,
    values: Mapping[str, Array],
    *,
    threads: int,
    should_stop: Callable[[], bool] | None = None,
    progress: Callable[[int, State], None] | None = None,
) -> tuple[Records, bool]:
    """Run a scene and write x, v and J = det F of its particles.

    Args:
        values: of the unknowns, by path.
        should_stop: looked at every control step; a stopped trajectory stays a readable `.part`.
        progress: called with every control step and its state.

    Returns:
        The probe's records, and whether the run came to its end.
    """
    model, particles = built.model, built.particles
    every = -(-model.n_controls // FRAMES)
    n_frames = -(-model.n_controls // every) + 1
    bodies = {name: particles.of(name) for name in particles.names}
    fields = {"v": (model.dim,), "J": ()}
    provenance = {"scene": dump(resolve(built.scene)), "engine": engine_hash(), "seed": built.scene.seed}
    rollout = Rollout(model, built.assembly.inputs(values), threads=threads)
    step = built.scene.time.control_step
    with TrajectoryWriter(path, n_frames, bodies, model.dim, fields, provenance) as writer:

        def observe(control: int, state: State) -> None:
            if progress is not None:
                progress(control, state)
            if control % every == 0 or control == model.n_controls:
                J = np.linalg.det(state.F)
                writer.write(writer.written, control * step, x=state.x, v=state.v, J=J, step=np.asarray(control))

        records = rollout.run(observe, should_stop)
        complete = writer.written == n_frames  # the last frame is that of the last control step
        if not complete:
            writer.abandon()
    return records, complete

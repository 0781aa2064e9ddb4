"""One forward run of a scene into a trajectory file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.engine.model import Records
from cqrun.engine.rollout import Rollout
from cqrun.fingerprint import engine_hash
from cqrun.plugin.contract import Array
from cqrun.scene.load import dump, resolve
from cqrun.state import State
from cqrun.store.atomic import write_table
from cqrun.store.trajectory import TrajectoryWriter

FRAMES = 300
"""Frames after the first that a trajectory has at the most, spread evenly over the control steps."""

MANY = 100
"""A value of more numbers is told by its range: attributes of HDF5 hold 64 KiB."""


def write_trajectory(
    path: Path,
    built: Built,
    rollout: Rollout,
    *,
    should_stop: Callable[[], bool] | None = None,
    progress: Callable[[int, State], None] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> tuple[Records, bool]:
    """Run a scene and write x, v, J = det F, the activation and the histories of its particles.

    Args:
        rollout: of the scene, or of one with another probe; not yet run.
        should_stop: looked at every control step; a stopped trajectory stays a readable `.part`.
        progress: called with every control step and its state.
        provenance: what else the file shall say of itself.

    Returns:
        The probe's records, and whether the run came to its end.
    """
    model, particles = built.model, built.particles
    every = -(-model.n_controls // FRAMES)
    n_frames = -(-model.n_controls // every) + 1
    bodies = {name: particles.of(name) for name in particles.names}
    fields: dict[str, tuple[int, ...]] = {"v": (model.dim,), "J": ()}
    if model.actuators:
        fields["activation"] = ()
    fields |= {field.name: field.shape for field in model.layout.history}
    said = {"scene": dump(resolve(built.scene)), "engine": engine_hash(), "seed": built.scene.seed}
    said |= provenance or {}
    step = built.scene.time.control_step
    with TrajectoryWriter(path, n_frames, bodies, model.dim, fields, said) as writer:

        def observe(control: int, state: State) -> None:
            if progress is not None:
                progress(control, state)
            if control % every == 0 or control == model.n_controls:
                values = {"x": state.x, "v": state.v, "J": np.linalg.det(state.F), "step": np.asarray(control)}
                if model.actuators:
                    values["activation"] = on_particles(rollout, max(control - 1, 0))
                values |= state.history
                writer.write(writer.written, control * step, **values)

        records = rollout.run(observe, should_stop)
        complete = writer.written == n_frames  # the last frame is that of the last control step
        if not complete:
            writer.abandon()
    return records, complete


def as_found(values: Mapping[str, Array]) -> dict[str, Any]:
    """Return what a trajectory says of the values that moved its bodies where its scene has others, by path."""

    def told(value: Array) -> Any:
        if value.size <= MANY:
            return value.tolist()
        return f"{value.size} numbers from {value.min():.6g} to {value.max():.6g}"

    return {"found": {path: told(np.asarray(value)) for path, value in values.items()}} if values else {}


def write_activation(path: Path, built: Built, activation: Array) -> None:
    """Write a table of what drove the actuators (T, A): a row a control step, a column for every part of one."""
    step = built.scene.time.control_step
    head = ["time", *(part.name for part in built.assembly.actuation.parts)]
    write_table(path, [head, *([k * step, *row] for k, row in enumerate(activation.tolist()))])


def on_particles(rollout: Rollout, control: int) -> Array:
    """Return what drove each particle in a control step (N,): the sum of the activations of its actuators."""
    out = np.zeros(rollout.model.layout.n_particles)
    for a, actuator in enumerate(rollout.model.actuators):
        out[actuator.particles] += rollout.activation[control, a]
    return out

"""Run a scene forward and write its trajectory file."""

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
from cqrun.running.extra_fields import ExtraFields, groups_of
from cqrun.running.measuring import Measuring
from cqrun.scene.load import dump, resolve
from cqrun.state import State
from cqrun.store.atomic import write_table
from cqrun.store.reactions import Reactions
from cqrun.store.rigid_motion import RigidMotions
from cqrun.store.trajectory import TrajectoryWriter

MANY = 100
"""If a value has more numbers than this, only its range is stored, because attributes of HDF5 hold 64 KiB at most."""


def frame_step(built: Built) -> int:
    """Return the number of control steps between the frames of a scene's trajectory."""
    return -(-built.model.n_controls // built.scene.trajectory.frames)


def count_frames(built: Built) -> int:
    """Return the number of frames of a scene's trajectory, with the start."""
    return -(-built.model.n_controls // frame_step(built)) + 1


def write_trajectory(
    path: Path,
    built: Built,
    rollout: Rollout,
    *,
    should_stop: Callable[[], bool] | None = None,
    progress: Callable[[int, State], None] | None = None,
    measuring: Measuring | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> tuple[Records, bool]:
    """Run a scene and write x, v, J = det F, activation and histories of its particles, and recorded reactions.

    Args:
        path: file to write.
        built: the scene.
        rollout: a rollout of the scene, perhaps with another probe, that has not run yet.
        should_stop: called at every control step; after a stop the trajectory remains a readable `.part` file.
        progress: called with every control step and its state.
        measuring: measures the quantities that the scene names; the file gets them, too.
        provenance: more attributes of the file.

    Returns:
        The records of the probe, and whether the run reached its end.
    """
    model, particles = built.model, built.particles
    every, extra = frame_step(built), ExtraFields(built)
    bodies = {name: particles.of(name) for name in particles.names}
    fields: dict[str, tuple[int, ...]] = {"v": (model.dim,), "J": ()}
    if model.actuators:
        fields["activation"] = ()
    fields |= {field.name: field.shape for field in model.layout.history} | extra.shapes
    attributes = {"scene": dump(resolve(built.scene)), "engine": engine_hash(), "seed": built.scene.seed}
    attributes |= provenance or {}
    step = built.scene.time.control_step
    with TrajectoryWriter(path, count_frames(built), bodies, model.dim, fields, attributes, groups_of(built)) as writer:

        def observe(control: int, state: State) -> None:
            if progress is not None:
                progress(control, state)
            if measuring is not None:
                measuring.look(state, rollout.inputs, rollout.activation[max(control - 1, 0)])
            if control % every == 0 or control == model.n_controls:
                values = {"x": state.x, "v": state.v, "J": np.linalg.det(state.F), "step": np.asarray(control)}
                if model.actuators:
                    values["activation"] = on_particles(rollout, max(control - 1, 0))
                values |= state.history | extra.at(state, rollout.inputs)
                writer.write(writer.written, control * step, **values)

        records = rollout.run(observe, should_stop)
        complete = writer.written == count_frames(built)  # the last frame belongs to the last control step
        if not complete:
            writer.abandon()
        else:
            if records.held:
                writer.add(Reactions.of(records.held, model.dim, step))
            if records.rigid:
                centers = {body.name: body.center[: model.dim] for body in model.rigid}
                writer.add(RigidMotions(step * np.arange(model.n_controls + 1), records.rigid, centers))
            if measuring is not None and (measured := measuring.end(records)) is not None:
                writer.add(measured)
    return records, complete


def as_found(values: Mapping[str, Array]) -> dict[str, Any]:
    """Return the attribute of a trajectory that has the values, by path, with which the run replaced the scene's."""

    def stored(value: Array) -> Any:
        if value.size <= MANY:
            return value.tolist()
        return f"{value.size} numbers from {value.min():.6g} to {value.max():.6g}"

    return {"found": {path: stored(np.asarray(value)) for path, value in values.items()}} if values else {}


def write_activation(path: Path, built: Built, activation: Array) -> None:
    """Write the activation (T, A) as a table: one row per control step, one column per part of an actuator."""
    step = built.scene.time.control_step
    head = ["time", *(part.name for part in built.assembly.actuation.parts)]
    write_table(path, [head, *([k * step, *row] for k, row in enumerate(activation.tolist()))])


def on_particles(rollout: Rollout, control: int) -> Array:
    """Return the activation of each particle in a control step (N,): the sum over its actuators."""
    out = np.zeros(rollout.model.layout.n_particles)
    for a, actuator in enumerate(rollout.model.actuators):
        out[actuator.particles] += rollout.activation[control, a]
    return out

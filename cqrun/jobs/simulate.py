"""`cqrun simulate`: run a scene forward; keep its trajectory and what its bodies did.

trajectory.h5     x, v and J of every particle, at most 300 frames
observables.csv   one row a control step (observables.py)
result.json       where the bodies ended, their extremes, what went wrong
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cqrun.engine.rollout import Rollout
from cqrun.errors import RolloutError, RunError
from cqrun.jobs.kernels import compile_kernels
from cqrun.jobs.observables import Observables
from cqrun.jobs.reporter import Reporter, Silent
from cqrun.jobs.runs import (
    build_and_warn,
    cores,
    open_run,
    raise_if_failed,
    refuse_overrides,
    saved_scene,
)
from cqrun.jobs.trajectories import write_trajectory
from cqrun.scene.build import Built
from cqrun.scene.load import load_scene
from cqrun.state import State
from cqrun.store.run import RunDirectory


def run_simulate(
    scene_source: Path,
    overrides: Sequence[str],
    out: Path,
    fresh: bool,
    threads: int | None,
    quiet: bool,
    *,
    reporter: Reporter | None = None,
) -> Path:
    """Run a scene forward with its own values; return the run's directory.

    Of several random activations the first one drives the actuators.

    Raises:
        SceneError, UsageError: bad input. RunError: it blew up. Stopped: it was asked to stop.
    """
    talk = reporter or Silent()
    built = build_and_warn(load_scene(scene_source, overrides), talk)
    n_threads = cores(threads)
    with open_run(
        scene_source, built.scene, out, job="simulate", threads=n_threads, fresh=fresh, with_data=False
    ) as run:
        if run.finished:
            talk.phase(f"finished already ({run.status}); --fresh starts over")
            return raise_if_failed(run)
        return simulate(run, built, n_threads, talk)


def resume_simulate(run: RunDirectory, overrides: Sequence[str], threads: int, talk: Reporter) -> Path:
    """Run a simulation that was stopped again, from its beginning.

    Raises:
        UsageError: overrides are given: they would make another run.
    """
    refuse_overrides(run, overrides)
    if run.finished:
        talk.phase(f"finished already ({run.status})")
        return raise_if_failed(run)
    return simulate(run, build_and_warn(saved_scene(run), talk), threads, talk)


def simulate(run: RunDirectory, built: Built, threads: int, talk: Reporter) -> Path:
    """Run a scene into a run directory."""
    run.begin(threads)
    compile_kernels([built], talk, adjoint=False)
    time, model = built.scene.time, built.model
    talk.phase(f"simulating {model.layout.n_particles} particles, {model.n_steps} substeps")
    reached = 0.0
    with Observables(run.path / "observables.csv", built) as watch:

        def observe(control: int, state: State) -> None:
            nonlocal reached
            reached = control * time.control_step
            watch.record(control, state)
            talk.advance(control, model.n_controls, f"t = {reached:.4g} of {time.duration:.4g} s")

        path = run.path / "trajectory.h5"
        rollout = Rollout(model, built.assembly.inputs({}), threads=threads)
        try:
            _, complete = write_trajectory(
                path, built, rollout, should_stop=lambda: talk.stop.asked, progress=observe
            )
        except RolloutError as error:
            run.write_result(_result(built, watch, "failed", str(error), reached))
            run.finish("failed", str(error))
            raise RunError(f"{run.path}: {error}") from error
        if not complete:
            message = f"stopped at t = {reached:.6g} s"
            run.finish("stopped", message)
            raise talk.stop.stopped(
                f"{message}; what there is so far lies in {path}.part; `cqrun resume {run.path}` runs it again"
            )
    result = _result(built, watch, "done", f"{time.duration:g} s simulated", reached)
    for sentence in result["findings"]:
        talk.warn(sentence)
        run.log(sentence)
    run.write_result(result)
    run.finish("done", result["message"])
    return run.path


def _result(built: Built, watch: Observables, status: str, message: str, time: float) -> dict[str, Any]:
    return {
        "job": "simulate",
        "status": status,
        "message": message,
        "time": time,
        "bodies": {
            body: {
                "centroid": [row[axis] for axis in "xyz"[: built.scene.dim]],
                "kinetic_energy": row["kinetic_energy"],
                "fastest": watch.fastest[body],
                "least_volume_ratio": watch.least_volume_ratio[body],
            }
            for body, row in watch.last.items()
        },
        "fracture": watch.fracture.most,
        "findings": watch.fracture.findings(),
    }

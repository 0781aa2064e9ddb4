"""`cqrun simulate`: run a scene forward, or what a run has learned; keep the trajectory and what the bodies did.

trajectory.h5     x, v and J of every particle, at most 300 frames
observables.csv   one row a control step (observables.py)
result.json       where the bodies ended, their extremes, what went wrong; the objective's terms
controller.npz    what acted, and activation.csv what drove the actuators, where there is a controller
identified.json   in a replay of a run of sysid that run's result, whose values act
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cqrun.build.model import Built
from cqrun.design.params import REGULARISER
from cqrun.engine.model import Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import RolloutError, RunError, SceneError, UsageError
from cqrun.jobs.bodies import tell_bodies
from cqrun.jobs.control import JOBS
from cqrun.learning.agent import FILE, Agent
from cqrun.learning.learned import constraints_of
from cqrun.learning.replay import (
    IDENTIFIED,
    as_overrides,
    identified_in,
    kept_of_identified,
    learned_in,
    refuse_learned,
    require_fitting,
)
from cqrun.plugin.contract import Array
from cqrun.running.kernels import compile_kernels
from cqrun.running.observables import Observables
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import (
    build_and_warn,
    finished_already,
    open_run,
    raise_if_failed,
    refuse_overrides,
    saved_scene,
    scene_in,
)
from cqrun.running.threads import cores
from cqrun.running.trajectories import as_found, write_activation, write_trajectory
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.scene.paths import get
from cqrun.scene.schema import Scene
from cqrun.state import State
from cqrun.store.atomic import write_bytes
from cqrun.store.result import RESULT, BodyMotion, SimulateResult, write_result
from cqrun.store.run import FINISHED, RunDirectory, read_record

UNTRAINED = "the controller has learned nothing yet: it acts with the parameters that it starts from"


def run_simulate(
    source: Path | str,
    overrides: Sequence[str],
    out: Path | str,
    *,
    fresh: bool = False,
    threads: int | None = None,
    controller: Path | str | None = None,
    reporter: Reporter | None = None,
) -> Path:
    """Run a scene forward with its own values; return the run's directory.

    Of several random activations the first one drives the actuators. A controller acts as a file has it, or as it
    starts, with every goal at its position.

    Args:
        source: a scene, or the directory of a run: its scene is run, under the controller that it trained or with the
            values that it identified.
        controller: file of a controller that acts in the place of the scene's, or of the run's own.

    Raises:
        SceneError, UsageError: bad input. RunError: it blew up. Stopped: it was asked to stop.
    """
    source, out = Path(source), Path(out)
    talk, n_threads = reporter or Silent(), cores(threads)
    trained, identified = None if controller is None else Path(controller), None
    if trained is None and source.is_dir():
        identified = _identified_by(source, talk)
        trained = _controller_of(source, talk) if identified is None else None
    unchanged, file, learned = _unchanged(source), trained or identified, dict[str, Array]()
    if trained is not None:
        learned = learned_in(trained)
    elif identified is not None:
        learned = identified_in(identified, unchanged or _scene(source, ()))
    if file is not None:
        refuse_learned(file, learned, unchanged, overrides)
    overrides = [*_standing_goals(unchanged), *overrides]
    scene = _scene(source, overrides)
    if file is not None:
        scene = _scene(source, [*as_overrides(file, learned, scene), *overrides])
    built = build_and_warn(scene, talk)
    agent, values = make_agent(built, trained, talk), _kept_values(built, identified)
    built = built if agent is None else agent.built
    stem = source.resolve().parent.name if source.is_dir() else source.stem
    files = {name: file for name, file in ((FILE, trained), (IDENTIFIED, identified)) if file is not None}
    with open_run(
        stem, built.scene, out, job="simulate", threads=n_threads, fresh=fresh, with_data=False, files=files
    ) as run:
        if finished_already(run, talk):
            return raise_if_failed(run)
        for name, file in files.items():
            write_bytes(run.path / name, file.read_bytes())
        return simulate(run, built, agent, values, n_threads, talk)


def _scene(source: Path, overrides: Sequence[str]) -> Scene:
    """Return the scene in a file, or that of a run."""
    return scene_in(source, overrides) if source.is_dir() else load_scene(source, overrides)


def _unchanged(source: Path) -> Scene | None:
    """Return the scene without overrides; None where it cannot be so: what is wrong is told with them in place."""
    try:
        return _scene(source, ())
    except (SceneError, UsageError):
        return None


def _standing_goals(scene: Scene | None) -> list[str]:
    """Return overrides that draw nothing: one episode, and goals where they are, so that they may be put anywhere."""
    goals = {} if scene is None else scene.goals
    drawn = [f"goals.{name}.spread=null" for name, goal in goals.items() if goal.spread is not None]
    return [*drawn, "episodes.count=1", "episodes.unseen=0", "episodes.fresh=false"] if drawn else []


def _controller_of(run: Path, talk: Reporter) -> Path:
    """Return the file of the controller that a run has trained."""
    record, file = read_record(run), run / FILE
    if not file.is_file():
        why = "no iteration is finished" if record.get("job") in JOBS else f"it is a run of {record.get('job')}"
        raise UsageError(
            f"{run}: has no trained controller ({why}): `cqrun simulate RUN` replays a run of control, codesign or "
            "sysid; to run a scene give its file"
        )
    if record["status"] not in FINISHED:
        talk.phase("the run is not finished: its best controller so far acts")
    return file


def _identified_by(run: Path, talk: Reporter) -> Path | None:
    """Return the result of a run of sysid, or the copy of it that a replay has; None for any other run."""
    record = read_record(run)
    if record.get("job") != "sysid":
        return run / IDENTIFIED if (run / IDENTIFIED).is_file() else None
    status, why = record["status"], f": {record['reason']}" if record.get("reason") else ""
    if status == "failed" or not (run / RESULT).is_file():
        raise UsageError(f"{run}: has identified nothing to replay ({status}{why}); to run its scene give the file")
    if status not in FINISHED:
        talk.phase("the run is not finished: the values act where it stands")
    return run / RESULT


def _kept_values(built: Built, identified: Path | None) -> dict[str, Array]:
    """Return the identified values by path that no scene can have: of groups and particles, and of shapes."""
    if identified is None:
        return {}
    kept = kept_of_identified(identified, built.scene, built.particles)
    require_fitting(identified, kept, make_params(built))
    return kept


def make_agent(built: Built, trained: Path | None, talk: Reporter) -> Agent | None:
    """Return what drives a scene's actuators: none where no controller does.

    Terms of the objective, and constraints, that do not fit the run are left out with a warning: recorded motions and
    key frames are for the time that they cover, and nothing is learned here.

    Raises:
        SceneError: an observer or the controller does not fit.
        UsageError: a controller is given for a scene without one, or for another one.
    """
    if built.scene.controller is None:
        if trained is not None:
            raise UsageError(f"{trained}: a controller for a scene that has none: add `controller` to the scene")
        return None
    try:
        return Agent(built, trained)
    except SceneError as error:
        scene, unfit = built.scene, [problem.path.partition(".") for problem in error.problems]
        if not all(section in ("objective", "constraints") and name for section, _, name in unfit):
            raise
        for problem in error.problems:
            talk.warn(f"{problem}: this run goes without it")
        left = {
            section: {name: term for name, term in getattr(scene, section).items() if (section, ".", name) not in unfit}
            for section in ("objective", "constraints")
        }
        return make_agent(replace(built, scene=scene.model_copy(update=left)), trained, talk)


def resume_simulate(run: RunDirectory, overrides: Sequence[str], threads: int, talk: Reporter) -> Path:
    """Run a simulation that was stopped again, from its beginning.

    Raises:
        UsageError: overrides are given: they would make another run.
    """
    refuse_overrides(run, overrides)
    if finished_already(run, talk, asked_by_scene=False):
        return raise_if_failed(run)
    built = build_and_warn(saved_scene(run), talk)
    agent = make_agent(built, _kept(run, FILE, "the controller"), talk)
    return simulate(run, built, agent, _kept_values(built, _kept(run, IDENTIFIED, "the result")), threads, talk)


def _kept(run: RunDirectory, name: str, what: str) -> Path | None:
    """Return the copy of a file that a run began with, if it began with one."""
    began_with, file = run.record["files"].get(name), run.path / name
    if began_with is None:
        return None
    if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != began_with:
        raise UsageError(f"{file}: this copy of {what} is not what the run began with; run the scene again")
    return file


def simulate(
    run: RunDirectory, built: Built, agent: Agent | None, values: Mapping[str, Array], threads: int, talk: Reporter
) -> Path:
    """Run a scene into a run directory, under its controller if it has one, else with values beside the scene's."""
    compile_kernels([built], talk, adjoint=False)
    run.begin(threads)
    if agent is None:
        rollout = Rollout(built.model, built.assembly.inputs(values), threads=threads)
        seen = as_found(values)
    else:
        rollout = agent.rollout(agent.acting, agent.goals_in_the_middle, threads)
        seen = agent.wanted(agent.goals_in_the_middle)
    otherwise = [] if agent is None else agent.otherwise
    for sentence in otherwise:
        talk.warn(sentence)
        run.log(sentence)
    tell_bodies(built, run, talk, rollout.inputs)
    time, model = built.scene.time, built.model
    talk.phase(f"simulating {model.layout.n_particles} particles, {model.n_steps} substeps")
    reached = 0.0
    with Observables(run.path / "observables.csv", built, rollout.inputs) as watch:

        def observe(control: int, state: State) -> None:
            nonlocal reached
            reached = control * time.control_step
            watch.record(control, state)
            talk.advance(control, model.n_controls, f"t = {reached:.4g} of {time.duration:.4g} s")

        path = run.path / "trajectory.h5"
        try:
            records, complete = write_trajectory(
                path, built, rollout, should_stop=lambda: talk.stop.asked, progress=observe, provenance=seen
            )
        except RolloutError as error:
            write_result(run.path, _result(built, watch, "failed", str(error), reached))
            run.finish("failed", str(error))
            raise RunError(f"{run.path}: {error}") from error
        if not complete:
            message = f"stopped at t = {reached:.6g} s"
            run.finish("stopped", message)
            raise talk.stop.stopped(
                f"{message}; what there is so far lies in {path}.part; `cqrun resume {run.path}` runs it again"
            )
    result = _result(built, watch, "done", f"{time.duration:g} s simulated", reached)
    if agent is not None and FILE not in run.record["files"]:
        result.findings.append(UNTRAINED)
    if agent is not None:
        _tell_acted(result, run, agent, rollout, records)
    for sentence in result.findings:
        talk.warn(sentence)
        run.log(sentence)
    result.findings += otherwise
    write_result(run.path, result)
    run.finish("done", result.message)
    return run.path


def _tell_acted(result: SimulateResult, run: RunDirectory, agent: Agent, rollout: Rollout, records: Records) -> None:
    """Write what drove the actuators; add to a result what an agent did: goals, terms, constraints."""
    write_activation(run.path / "activation.csv", agent.built, rollout.activation)
    goals = agent.goals_in_the_middle
    found, departure = agent.judged(rollout, records, goals), _departure(agent)
    result.goals = {name: goal.tolist() for name, goal in goals.items()}
    if found.terms:
        result.loss = float(found.loss) + sum(departure.values())
        result.terms = {name: float(value) for name, value in found.terms.items()} | departure
    result.constraints = constraints_of(agent.built.scene, [found])


def _departure(agent: Agent) -> dict[str, float]:
    """Return the unknowns' regularisers of what acts, as a term, from where the training started; none without one."""
    found = 0.0
    for block in agent.params.blocks if agent.params.regularised else ():
        if block.regulariser:
            value = agent.acting.get(block.path, np.array(get(agent.built.scene, block.path), float))
            found += replace(block, initial=agent.starts[block.path]).departure(value)
    return {REGULARISER: found} if agent.params.regularised else {}


def _result(built: Built, watch: Observables, status: str, message: str, time: float) -> SimulateResult:
    return SimulateResult(
        status=status,
        message=message,
        time=time,
        bodies={
            body: BodyMotion(
                centroid=[row[axis] for axis in "xyz"[: built.scene.dim]],
                kinetic_energy=row["kinetic_energy"],
                fastest=watch.fastest[body],
                least_volume_ratio=watch.least_volume_ratio[body],
            )
            for body, row in watch.last.items()
        },
        fracture=watch.fracture.most,
        findings=watch.fracture.findings(),
    )

"""`cqrun simulate`: run a scene, or the result of a run, forward; write the trajectory and the motion of the bodies.

trajectory.h5     x, v and J of every particle, at most 300 frames
observables.csv   one row per control step (observables.py)
measurements.csv  the quantities that the scene measures, one row per control step (store/measured.py)
reactions.csv     force and moment of every boundary for each control step, in the reference frame (reaction_table.py)
result.json       final positions and extreme values of the bodies, findings, the objective's terms
controller.npz    the controller, if there is one, and activation.csv the activations of the actuators
identified.json   in a replay of a run of sysid: the result of that run, with the values in use
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.build.thickness import thinnest_parts
from cqrun.design.params import REGULARISER
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import Problem, RolloutError
from cqrun.jobs.job import NO_FILES, Job
from cqrun.learning.acting import acting_in, identified_values, make_agent
from cqrun.learning.agent import FILE, Agent
from cqrun.learning.description import constraint_cells
from cqrun.learning.learned import constraints_of
from cqrun.learning.replay import IDENTIFIED
from cqrun.plugin.contract import Array
from cqrun.running.bodies import report_bodies, resolved_lines
from cqrun.running.cost import about
from cqrun.running.drift import drift_findings
from cqrun.running.kernels import compile_kernels
from cqrun.running.measuring import Measuring, measured_lines, write_measured
from cqrun.running.observables import Observables
from cqrun.running.passing import Passing
from cqrun.running.reaction_table import summary_of, with_reactions, write_reaction_table
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import Source, build_and_warn, raise_if_failed
from cqrun.running.tables import number, table
from cqrun.running.trajectories import as_found, write_activation, write_trajectory
from cqrun.scene.paths import get
from cqrun.scene.schema import Scene
from cqrun.state import State
from cqrun.store.reactions import Reactions
from cqrun.store.result import BodyMotion, SimulateResult, write_result
from cqrun.store.run import RunDirectory
from cqrun.units import force_units

UNTRAINED = "the controller has learned nothing yet: it uses the parameters that it starts from"


@dataclass(frozen=True)
class Simulation:
    """A scene that is ready to run.

    Attributes:
        agent: drives the actuators; None without a controller.
        values: identified values by path, which are not in the scene.
    """

    built: Built
    agent: Agent | None
    values: Mapping[str, Array]
    threads: int


@dataclass(frozen=True)
class Simulate(Job[Simulation, SimulateResult]):
    """Run a scene forward from its start."""

    def prepare(self, scene: Scene, threads: int, talk: Reporter, files: Mapping[str, Path] = NO_FILES) -> Simulation:
        """Build a scene, with its controller or one from a file, or with the values that a run of sysid found."""
        built = with_reactions(build_and_warn(scene, talk))
        if scene.path:
            message = "has no effect on a motion: `cqrun rest` goes along it"
            talk.warn(str(Problem(scene.where("path"), "path", message)))
        agent = make_agent(built, files.get(FILE), talk)
        values = identified_values(built, files.get(IDENTIFIED))
        return Simulation(built if agent is None else agent.built, agent, values, threads)

    def read(self, source: Path, overrides: Sequence[str], talk: Reporter) -> Source:
        """Return the scene of a file, or the scene and the result of a run, as `acting_in`."""
        return acting_in(source, overrides, None, talk)

    def reads_data(self, scene: Scene) -> bool:
        """Return False: a simulation reads no recordings."""
        return False

    def work(self, run: RunDirectory, prepared: Simulation, talk: Reporter) -> None:
        """Run a scene and write the files of its run directory."""
        built, agent = prepared.built, prepared.agent
        compile_kernels([built], talk, adjoint=False)
        run.begin(prepared.threads)
        rollout, provenance = _rollout(prepared)
        changes = [] if agent is None else agent.changes
        for sentence in changes:
            talk.warn(sentence)
            run.log(sentence)
        report_bodies(built, run, talk, rollout.inputs)
        time, model = built.scene.time, built.model
        lasts = about(model, each="in all")
        talk.phase(f"simulating {model.layout.n_particles} particles, {model.n_steps} substeps, {lasts}")
        reached, last, passing = 0.0, rollout.inputs.state, Passing(built)
        measuring = Measuring(built, prepared.values)
        with Observables(run.path / "observables.csv", built, rollout.inputs) as watch:

            def observe(control: int, state: State) -> None:
                nonlocal reached, last
                last = state
                reached = control * time.control_step
                watch.record(control, state)
                passing.at_control(control, state)
                talk.advance(control, model.n_controls, f"t = {reached:.4g} of {time.duration:.4g} s")

            path = run.path / "trajectory.h5"
            try:
                records, complete = write_trajectory(
                    path, built, rollout, should_stop=lambda: talk.stop.asked, progress=observe, measuring=measuring,
                    provenance=provenance,
                )  # fmt: skip
            except RolloutError as error:
                result = _result(built, watch, "failed", str(error), reached)
                result.findings += passing.findings()
                measuring.end(Records.zeros(0, 0, built.model.dim))
                write_measured(run.path, measuring, result)
                for sentence in result.findings:
                    talk.warn(sentence)
                    run.log(sentence)
                write_result(run.path, result)
                run.finish("failed", str(error))
                return
            if not complete:
                message = f"stopped at t = {reached:.6g} s"
                run.finish("stopped", talk.stop.named(message))
                raise talk.stop.stopped(
                    f"{message}; the trajectory so far is in {path}.part; `cqrun resume {run.path}` runs it again"
                )
        result = _result(built, watch, "done", f"{time.duration:g} s simulated", reached)
        if agent is not None and agent.controller.learned and FILE not in run.record["files"]:
            result.findings.append(UNTRAINED)
        if agent is not None:
            _add_episode(result, run, agent, rollout, records)
        if records.held:
            result.boundaries = summary_of(records.held, model.dim)
            reactions = Reactions.of(records.held, model.dim, time.control_step)
            write_reaction_table(run.path / "reactions.csv", reactions)
        write_measured(run.path, measuring, result)
        result.findings += [*passing.findings(), *rollout.remarks(), *drift_findings(built, last)]
        for sentence in result.findings:
            talk.warn(sentence)
            run.log(sentence)
        result.findings += changes
        write_result(run.path, result)
        run.finish("done", result.message)

    def lines(self, run: Path, result: SimulateResult) -> Iterator[str]:
        """Yield every body's final position and extreme values, the terms of the objective, and the constraints."""
        yield f"{result.status}: {result.message}"
        yield ""
        head = ("body", "centroid at the end [m]", "fastest [m/s]", "least volume ratio", "kinetic energy")
        rows = [
            (body, ", ".join(map(number, m.centroid)), number(m.fastest), number(m.least_volume_ratio),
             number(m.kinetic_energy)) for body, m in result.bodies.items()
        ]  # fmt: skip
        yield from table(head, rows)
        yield from resolved_lines(result.thinnest)
        yield from measured_lines(result.measured)
        if result.boundaries:
            forces = [
                (name, ", ".join(map(number, force.mean)), number(force.largest))
                for name, force in result.boundaries.items()
            ]
            unit, _ = force_units(max(len(force.mean) for force in result.boundaries.values()))
            yield ""
            yield from table(("boundary", f"mean force on the bodies [{unit}]", f"largest [{unit}]"), forces)
        if result.terms is not None and result.loss is not None:
            values = {**result.terms, "loss": result.loss}
            yield ""
            yield from table(("term", "value"), [(name, number(value)) for name, value in values.items()])
        if result.constraints:
            cells = [(name, *constraint_cells(value)) for name, value in result.constraints.items()]
            yield ""
            yield from table(("constraint", "wanted", "value", "violated by"), cells)
        yield from (f"note: {sentence}" for sentence in result.findings)


KEPT = {FILE: "the controller", IDENTIFIED: "the result"}
SIMULATE = Simulate("simulate", SimulateResult, pictures=("bodies", "measured", "reactions"), keeps=KEPT)


def run_simulate(
    source: Path | str, overrides: Sequence[str], out: Path | str, *, fresh: bool = False, threads: int | None = None,
    controller: Path | str | None = None, reporter: Reporter | None = None,
) -> Path:  # fmt: skip
    """Run a scene forward; return the run's directory.

    If there are several random activations, the first drives the actuators. Every goal is in the middle of its range.

    Args:
        source: a scene, or a run directory: then its scene is run with the controller that the run trained, or with the
            values that it identified.
        controller: file of a controller that replaces that of the scene or of the run.

    Raises:
        SceneError, UsageError: bad input. RunError: the scene blew up. Stopped: asked to stop.
    """
    talk = reporter or Silent()
    given = acting_in(Path(source), overrides, None if controller is None else Path(controller), talk)
    run = SIMULATE.start(given.stem, given.scene, out, files=given.files, fresh=fresh, threads=threads, reporter=talk)
    return raise_if_failed(run)


def _rollout(prepared: Simulation) -> tuple[Rollout, dict[str, Any]]:
    """Return the rollout, and the attributes of its trajectory."""
    built, agent, threads = prepared.built, prepared.agent, prepared.threads
    if agent is None:
        inputs = built.assembly.inputs(prepared.values)
        return make_rollout(built.model, inputs, threads=threads), as_found(prepared.values)
    goals = agent.goals_in_the_middle
    return agent.rollout(agent.acting, goals, threads), agent.wanted(goals)


def _add_episode(result: SimulateResult, run: RunDirectory, agent: Agent, rollout: Rollout, records: Records) -> None:
    """Write the activations; add goals, terms and constraints to the result."""
    write_activation(run.path / "activation.csv", agent.built, rollout.activation)
    goals = agent.goals_in_the_middle
    attempt, departure = agent.judged(rollout, records, goals), _departure(agent)
    result.goals = {name: goal.tolist() for name, goal in goals.items()}
    if attempt.terms:
        result.loss = float(attempt.loss) + sum(departure.values())
        result.terms = {name: float(value) for name, value in attempt.terms.items()} | departure
    result.constraints = constraints_of(agent.built.scene, [attempt])


def _departure(agent: Agent) -> dict[str, float]:
    """Return the regularisers of the unknowns, from the start of the training, as a term; empty without regulariser."""
    total = 0.0
    for block in agent.params.blocks if agent.params.regularised else ():
        if block.regulariser:
            value = agent.acting.get(block.path, np.array(get(agent.built.scene, block.path), float))
            total += replace(block, initial=agent.starts[block.path]).departure(value)
    return {REGULARISER: total} if agent.params.regularised else {}


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
        thinnest=thinnest_parts(built),
    )

"""`cqrun simulate`: run a scene forward, or what a run has learned; keep the trajectory and what the bodies did.

trajectory.h5     x, v and J of every particle, at most 300 frames
observables.csv   one row a control step (observables.py)
result.json       where the bodies ended, their extremes, what went wrong; the objective's terms
controller.npz    what acted, and activation.csv what drove the actuators, where there is a controller
identified.json   in a replay of a run of sysid that run's result, whose values act
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.design.params import REGULARISER
from cqrun.engine.model import Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import RolloutError
from cqrun.jobs.job import NO_FILES, Job
from cqrun.learning.acting import acting_in, identified_values, make_agent
from cqrun.learning.agent import FILE, Agent
from cqrun.learning.description import constraint_cells
from cqrun.learning.learned import constraints_of
from cqrun.learning.replay import IDENTIFIED
from cqrun.plugin.contract import Array
from cqrun.running.bodies import tell_bodies
from cqrun.running.cost import about
from cqrun.running.kernels import compile_kernels
from cqrun.running.observables import Observables
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import build_and_warn, raise_if_failed
from cqrun.running.tables import number, table
from cqrun.running.trajectories import as_found, write_activation, write_trajectory
from cqrun.scene.paths import get
from cqrun.scene.schema import Scene
from cqrun.state import State
from cqrun.store.result import BodyMotion, SimulateResult, write_result
from cqrun.store.run import RunDirectory

UNTRAINED = "the controller has learned nothing yet: it acts with the parameters that it starts from"


@dataclass(frozen=True)
class Simulation:
    """A scene that is ready to be run forward.

    Attributes:
        agent: what drives its actuators; None where no controller does.
        values: what was identified, by path, beside the scene's own values.
    """

    built: Built
    agent: Agent | None
    values: Mapping[str, Array]
    threads: int


@dataclass(frozen=True)
class Simulate(Job[Simulation, SimulateResult]):
    """Run a scene forward, from its beginning."""

    def prepare(self, scene: Scene, threads: int, talk: Reporter, files: Mapping[str, Path] = NO_FILES) -> Simulation:
        """Build a scene, under its controller or one from a file, or with values from the result of a run of sysid."""
        built = build_and_warn(scene, talk)
        agent = make_agent(built, files.get(FILE), talk)
        values = identified_values(built, files.get(IDENTIFIED))
        return Simulation(built if agent is None else agent.built, agent, values, threads)

    def reads_data(self, scene: Scene) -> bool:
        """Return False: a simulation reads no recordings."""
        return False

    def work(self, run: RunDirectory, prepared: Simulation, talk: Reporter) -> None:
        """Run a scene into a run directory, under its controller if it has one, else with values beside the scene's."""
        built, agent = prepared.built, prepared.agent
        compile_kernels([built], talk, adjoint=False)
        run.begin(prepared.threads)
        rollout, provenance = _rollout(prepared)
        otherwise = [] if agent is None else agent.otherwise
        for sentence in otherwise:
            talk.warn(sentence)
            run.log(sentence)
        tell_bodies(built, run, talk, rollout.inputs)
        time, model = built.scene.time, built.model
        lasts = about(model, each="in all")
        talk.phase(f"simulating {model.layout.n_particles} particles, {model.n_steps} substeps, {lasts}")
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
                    path, built, rollout, should_stop=lambda: talk.stop.asked, progress=observe, provenance=provenance
                )
            except RolloutError as error:
                write_result(run.path, _result(built, watch, "failed", str(error), reached))
                run.finish("failed", str(error))
                return
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

    def lines(self, run: Path, result: SimulateResult) -> Iterator[str]:
        """Yield where every body ended and its extremes, the terms of the objective, and the constraints."""
        yield f"{result.status}: {result.message}"
        yield ""
        rows = [
            (
                body,
                ", ".join(number(c) for c in motion.centroid),
                number(motion.fastest),
                number(motion.least_volume_ratio),
                number(motion.kinetic_energy),
            )
            for body, motion in result.bodies.items()
        ]
        yield from table(
            ("body", "centroid at the end [m]", "fastest [m/s]", "least volume ratio", "kinetic energy"), rows
        )
        if result.terms is not None and result.loss is not None:
            values = {**result.terms, "loss": result.loss}
            yield ""
            yield from table(("term", "value"), [(name, number(value)) for name, value in values.items()])
        if result.constraints:
            cells = [(name, *constraint_cells(found)) for name, found in result.constraints.items()]
            yield ""
            yield from table(("constraint", "wanted", "value", "violated by"), cells)
        yield from (f"note: {sentence}" for sentence in result.findings)


SIMULATE = Simulate(
    "simulate",
    SimulateResult,
    pictures=("bodies",),
    keeps={FILE: "the controller", IDENTIFIED: "the result"},
)


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
    talk = reporter or Silent()
    acting = acting_in(Path(source), overrides, None if controller is None else Path(controller), talk)
    run = SIMULATE.start(
        acting.stem, acting.scene, out, files=acting.files, fresh=fresh, threads=threads, reporter=talk
    )
    return raise_if_failed(run)


def _rollout(prepared: Simulation) -> tuple[Rollout, dict[str, Any]]:
    """Return the rollout that is simulated, and what its trajectory says of where it comes from."""
    built, agent, threads = prepared.built, prepared.agent, prepared.threads
    if agent is None:
        inputs = built.assembly.inputs(prepared.values)
        return Rollout(built.model, inputs, threads=threads), as_found(prepared.values)
    goals = agent.goals_in_the_middle
    return agent.rollout(agent.acting, goals, threads), agent.wanted(goals)


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

"""How a case is run: in motion by a rollout, or at rest by a path of equilibria; both give records and gradients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cqrun.build.load_path import gradient_of, inputs_of
from cqrun.build.model import Built
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.path import Point, RestPath, RestRecords
from cqrun.errors import NoRestError
from cqrun.explain import listed
from cqrun.plugin.contract import Array
from cqrun.running.cost import about
from cqrun.running.drift import drift_findings
from cqrun.running.extra_fields import ExtraFields
from cqrun.running.measuring import Measuring
from cqrun.running.passing import Passing
from cqrun.running.reaction_table import with_reactions
from cqrun.running.rest_table import rest_frames, write_frame
from cqrun.running.side_by_side import Effort
from cqrun.running.trajectories import write_trajectory
from cqrun.state import State

Values = Mapping[str, Array]
Observe = Callable[[int, State], None]

TOLERANCE = 1e-10
"""Net force at rest divided by the loads: differences of equilibria give the Jacobian of a fit."""


class Runner(Protocol):
    """Runs the model of a case with values by path in its scene."""

    def run(
        self, values: Values, threads: int = 1, observe: Observe | None = None, near: Records | None = None
    ) -> Records:
        """Return the records; call `observe` with the number and the state of each of their rows.

        Args:
            near: records of a run with other values. A run at rest starts from its equilibria.
        """
        ...

    def still(self) -> Records:
        """Return the records of bodies that do not move."""
        ...

    def gradient(
        self, values: Values, loss_bar: Callable[[Records], Records], threads: int = 1, budget: int | None = None,
        near: Records | None = None,
    ) -> tuple[dict[str, Array], Effort]:  # fmt: skip
        """Return the gradient by path, and its cost.

        Args:
            loss_bar: returns the cotangent of the records.
            budget: bytes for kept states; those of the model if None.
            near: as for `run`.
        """
        ...

    def write(
        self, path: Path, values: Values, threads: int, provenance: Mapping[str, Any], measuring: Measuring
    ) -> list[str]:
        """Write a trajectory with measured quantities; return sentences about what is notable in it."""
        ...


@dataclass(frozen=True)
class InMotion:
    """A rollout."""

    built: Built

    def run(
        self, values: Values, threads: int = 1, observe: Observe | None = None, near: Records | None = None
    ) -> Records:
        """Return the records of all control steps."""
        return make_rollout(self.built.model, self.built.assembly.inputs(values), threads=threads).run(observe)

    def still(self) -> Records:
        """Return the records of bodies that do not move, on which no boundary acts."""
        model, count = self.built.model, self.built.model.n_controls + 1
        size = model.dim + (1 if model.dim == 2 else 3)
        held = {name: np.zeros((count, size)) for name in model.reactions}
        rigid = {body.name: np.zeros((count, 6 if model.dim == 2 else 12)) for body in model.rigid}
        return replace(_still(self.built, count), held=held, rigid=rigid)

    def gradient(
        self, values: Values, loss_bar: Callable[[Records], Records], threads: int = 1, budget: int | None = None,
        near: Records | None = None,
    ) -> tuple[dict[str, Array], Effort]:  # fmt: skip
        """Return the gradient by path, and its cost."""
        built = self.built
        model = built.model if budget is None else replace(built.model, memory_budget=budget)
        rollout = make_rollout(model, built.assembly.inputs(values), threads=threads, adjoint=True)
        _, bar = rollout.gradient(lambda records, final: LossBar(loss_bar(records)))
        return built.assembly.gradient(values, bar), Effort.of(rollout)

    def write(
        self, path: Path, values: Values, threads: int, provenance: Mapping[str, Any], measuring: Measuring
    ) -> list[str]:
        """Write the trajectory; return what is notable of the substep, and of positions that drift."""
        built = with_reactions(self.built) if measuring.late else self.built
        rollout = make_rollout(built.model, built.assembly.inputs(values), threads=threads)
        last, passing = rollout.inputs.state, Passing(built)

        def keep(control: int, state: State) -> None:
            nonlocal last
            last = state
            passing.at_control(control, state)

        write_trajectory(path, built, rollout, provenance=provenance, progress=keep, measuring=measuring)
        return [*passing.findings(), *rollout.remarks(), *drift_findings(self.built, last)]


@dataclass(frozen=True)
class AtRest:
    """A path of equilibria.

    Attributes:
        points: the loads of each, by key path in the scene; they replace other values there.
        names: what each is called in messages.
    """

    built: Built
    points: tuple[Mapping[str, float], ...]
    names: tuple[str, ...] = ()

    def run(
        self, values: Values, threads: int = 1, observe: Observe | None = None, near: Records | None = None
    ) -> RestRecords:
        """Return the records of the rest shape and of all points.

        Raises:
            NoRestError: a point has no equilibrium.
        """
        return self._find(values, threads, observe, near)[1]

    def still(self) -> RestRecords:
        """Return the records of bodies that do not move; no boundary has to hold them."""
        model, count = self.built.model, len(self.points) + 1
        size = model.dim + (1 if model.dim == 2 else 3)
        names = [*(condition.name for condition in model.conditions), *(body.name for body in model.rigid)]
        held = {name: np.zeros((count, size)) for name in names}
        return RestRecords.joined(_still(self.built, count), held)

    def gradient(
        self, values: Values, loss_bar: Callable[[Records], Records], threads: int = 1, budget: int | None = None,
        near: Records | None = None,
    ) -> tuple[dict[str, Array], Effort]:  # fmt: skip
        """Return the gradient by path, summed over all points."""
        path, records = self._find(values, threads, None, near, keep=True)
        total = {key: np.zeros(np.shape(value)) for key, value in values.items()}
        for point, bar in zip(self.points, path.gradients(loss_bar(records)), strict=True):
            for key, part in gradient_of(self.built, point, values, bar).items():
                total[key] += part
        return total, Effort()

    def write(
        self, path: Path, values: Values, threads: int, provenance: Mapping[str, Any], measuring: Measuring
    ) -> list[str]:
        """Write a trajectory with the rest shape and a frame for every point."""
        inputs = [inputs_of(self.built, point, values) for point in self.points]
        neutral, extra = self.built.assembly.actuation.neutral, ExtraFields(self.built)
        with rest_frames(path, self.built, len(self.points), provenance) as writer:

            def note(number: int, state: State) -> None:
                here = inputs[max(number - 1, 0)]
                write_frame(writer, state, number, extra.at(state, here))
                measuring.look(state, here, here.activation[-1] if number else neutral)

            records = self._find(values, threads, note)[1]
            if (measured := measuring.end(records, at_rest=True)) is not None:
                writer.add(measured)
        return []

    def path(self, values: Values, threads: int = 1, near: Records | None = None) -> RestPath:
        """Return the path, without any point yet."""
        inputs = [inputs_of(self.built, point, values) for point in self.points]
        found = near.found if isinstance(near, RestRecords) else ()
        return RestPath(self.built.model, inputs, threads=threads, tolerance=TOLERANCE, apart=True, near=found)

    def _find(
        self,
        values: Values,
        threads: int,
        observe: Observe | None,
        near: Records | None = None,
        *,
        keep: bool = False,
    ) -> tuple[RestPath, RestRecords]:
        path = self.path(values, threads, near)

        def note(number: int, here: Equilibrium, point: Point) -> None:
            if observe is not None and point.rest.converged:
                observe(number + 1, here.state(point.rest.u))

        if observe is not None:
            observe(0, path.start.state(path.rest_shape))
        records = path.run(note, keep=keep)
        last = path.points[-1]
        if not last.rest.converged:
            number = len(path.points)
            loads = ", ".join(f"{key}={value:.6g}" for key, value in self.points[number - 1].items())
            named = f", {self.names[number - 1]}" if self.names else ""
            raise NoRestError(
                f"no equilibrium was found at point {number} of {len(self.points)}{named}"
                f"{f' ({loads})' if loads else ''}: {100 * last.reached:.0f} % of the way to it was covered",
                "the body buckles or collapses there: use a stiffer material or smaller loads, or narrower bounds",
            )
        return path, records


def _still(built: Built, rows: int) -> Records:
    """Return the records of bodies that do not move, so many rows of them."""
    model, probe = built.model, built.model.probe
    assert probe is not None
    shape = (rows, probe.shape[0], model.dim)
    zeros = np.zeros((*shape, model.dim))
    x = np.broadcast_to(probe @ built.particles.x, shape)
    return Records(x, np.zeros(shape), zeros, zeros + np.eye(model.dim))


def how_long(runners: Sequence[Runner], *, gradients: bool = False) -> str:
    """Return words on the time of an evaluation: of a rollout, or how many equilibria it has."""
    moving = [about(runner.built.model, gradients=gradients) for runner in runners if isinstance(runner, InMotion)]
    count = sum(len(runner.points) for runner in runners if isinstance(runner, AtRest))
    resting = [f"{count} equilibri{'um' if count == 1 else 'a'}{' each time' if count else ''}"] if count else []
    return listed([*moving[:1], *resting])

"""`cqrun gradcheck`: compare the adjoint of a scene's loss with finite differences, direction by direction.

A direction changes one block of values (one unknown; a random direction if it has many numbers), or all of them;
running/finite_differences.py compares along it.

With data the loss is that of the fit, with unknowns in scaled coordinates (bounds are 1 apart). With a controller and
an objective it is that of the first episode, as a function of the controller's parameters and the unknowns. Otherwise
it is a random linear function of the final state (with `job: rest` of the equilibria), as a function of all numbers of
the scene that gradients reach.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.build.model import Built
from cqrun.design.params import Params
from cqrun.errors import RolloutError, RunError
from cqrun.fitting.case import Case
from cqrun.fitting.cases import given_cases, is_fit, made_cases
from cqrun.fitting.fit_loss import fit_loss
from cqrun.jobs.job import NO_FILES, Job
from cqrun.jobs.rest import require_no_time
from cqrun.learning.agent import Agent
from cqrun.learning.episode_loss import episode_loss
from cqrun.learning.episodes import EpisodeProblem, has_episodes
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.running.cost import about
from cqrun.running.finite_differences import (
    AGREES,
    ALL_STEPS,
    AT_A_KINK,
    DISAGREES,
    FLAT,
    STEPS,
    TOO_ROUGH,
    check_direction,
)
from cqrun.running.gradient_memory import gradient_plan
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.rest_loss import rest_loss
from cqrun.running.runs import build_and_warn
from cqrun.running.state_loss import state_loss
from cqrun.scene.schema import Scene
from cqrun.store.result import Direction, GradcheckResult, Verdict, write_result
from cqrun.store.run import RunDirectory, read_record

VERDICTS: dict[Verdict, str] = {
    AGREES: "",
    AT_A_KINK: "at a kink: agrees with the slope of one side",
    FLAT: "flat: nothing to compare",
    TOO_ROUGH: "TOO ROUGH TO TELL",
    DISAGREES: "DISAGREES",
}
"""The text of each verdict in the table."""

SUMMARY: dict[Verdict, str] = {
    AGREES: "adjoint and differences agree",
    TOO_ROUGH: "differences are too rough to tell whether the adjoint is right",
    DISAGREES: "adjoint and differences disagree",
}

ALL = "all together"


@dataclass(frozen=True)
class GradientCheck:
    """A scene that is ready for the check.

    Attributes:
        cases: cases of its fit; None if it has no fit, or if its synthetic data are not made yet.
        episodes: its episodes, if it has any.
    """

    built: Built
    cases: list[Case] | None
    episodes: EpisodeProblem | None
    threads: int


@dataclass(frozen=True)
class Gradcheck(Job[GradientCheck, GradcheckResult]):
    """Check the adjoint of a scene's loss."""

    def prepare(
        self, scene: Scene, threads: int, talk: Reporter, files: Mapping[str, Path] = NO_FILES
    ) -> GradientCheck:
        """Build a scene, and read its data if it has a fit; raise SceneError if gradients do not fit the memory."""
        if at_rest(scene):
            require_no_time(scene)
        built = build_and_warn(scene, talk)
        if not at_rest(scene):
            gradient_plan(built)
        cases = given_cases(built) if has_data(built.scene) else None
        episodes = EpisodeProblem(Agent(built), threads=threads) if has_episodes(built.scene) else None
        return GradientCheck(built, cases, episodes, threads)

    def reads_data(self, scene: Scene) -> bool:
        """Return whether the scene has a fit to differentiate."""
        return has_data(scene)

    def work(self, run: RunDirectory, prepared: GradientCheck, talk: Reporter) -> None:
        """Check all directions.

        Raises:
            RunError: the scene blows up with its start values. StopAsked: asked to stop.
        """
        built, cases, episodes, threads = prepared.built, prepared.cases, prepared.episodes, prepared.threads
        moving = [built] * (not at_rest(built.scene)) if cases is None else [c.built for c in cases if not c.points]
        compile_kernels(moving, talk, adjoint=True)
        run.begin(threads)
        if has_data(built.scene) and cases is None:
            talk.phase(f"making data, {about(built.model)}")
            cases = made_cases(run, built, talk.stop.check)
        lasts = "" if at_rest(built.scene) else f", {about(built.model, gradients=True)}"
        talk.phase(f"computing the gradient{lasts}")
        try:
            if episodes is not None:
                loss = episode_loss(episodes)
            else:
                alone = rest_loss if at_rest(built.scene) else state_loss
                loss = alone(built, threads) if cases is None else fit_loss(built, cases, threads)
            loss = loss.interrupted_by(talk.stop.check)
            value, gradient = loss.value_and_grad(loss.x)
        except (RolloutError, TrialFailed) as error:
            run.finish("failed", f"with the start values: {error}")
            raise RunError(f"{run.path}: with the start values: {error}") from error
        lasts = "equilibria each" if at_rest(built.scene) else f"rollouts each, {about(built.model)}"
        talk.phase(f"checking {len(loss.params.blocks)} blocks by {2 * len(STEPS)} {lasts}")
        chosen = directions(loss.params, np.random.default_rng(built.scene.seed))
        rows: list[Direction] = []
        for number, (block, d) in enumerate(chosen.items()):
            talk.advance(number, len(chosen), f"{number} of {len(chosen)} directions, now {block}")
            rows.append(check_direction(block, loss, value, gradient, d, built.scene.precision))
        agrees, steps = all(row.agrees for row in rows), ALL_STEPS[: max(len(row.scan) for row in rows)].tolist()
        write_result(run.path, GradcheckResult(agrees=agrees, loss=value, of=loss.words, steps=steps, rows=rows))
        run.finish("done" if agrees else "failed", SUMMARY[_worst(row.verdict for row in rows)])

    def lines(self, run: Path, result: GradcheckResult) -> Iterator[str]:
        """Yield a line for every direction, and the verdict on all of them."""
        width = max(len(row.block) for row in result.rows)
        yield f"gradient of {result.of} = {result.loss:.6g}"
        yield f"{'block':{width}}  numbers  {'adjoint':>14}  {'differences':>14}  {'error':>8}  {'step':>8}"
        for row in result.rows:
            head = f"{row.block:{width}}  {row.count:7d}  {row.adjoint:14.7e}"
            if row.differences is None:
                yield f"{head}  every step's rollout failed: DISAGREES"
            else:
                verdict = VERDICTS[row.verdict]
                yield f"{head}  {row.differences:14.7e}  {row.error:8.1e}  {row.step:8.1e}  {verdict}".rstrip()
        yield SUMMARY[_worst(row.verdict for row in result.rows)].replace("disagree", "DISAGREE")


GRADCHECK = Gradcheck("gradcheck", GradcheckResult)


def run_gradcheck(
    source: Path | str, overrides: Sequence[str], out: Path | str, *, fresh: bool = False, threads: int | None = None,
    reporter: Reporter | None = None,
) -> tuple[Path, bool]:  # fmt: skip
    """Check a scene's gradient; return the run's directory and whether all directions agree.

    Raises:
        SceneError, UsageError: bad input. RunError: the scene blows up with its start values. Stopped: asked to stop.
    """
    given = GRADCHECK.read(Path(source), overrides, reporter or Silent())
    run = GRADCHECK.start(given.stem, given.scene, out, fresh=fresh, threads=threads, reporter=reporter)
    return run, read_record(run)["status"] == "done"


def has_data(scene: Scene) -> bool:
    """Return whether a scene has a fit to differentiate."""
    return is_fit(scene)


def at_rest(scene: Scene) -> bool:
    """Return whether the gradients of a scene are those of equilibria."""
    return scene.job == "rest"


def _worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the verdict on all directions together."""
    given = set(verdicts)
    return DISAGREES if DISAGREES in given else TOO_ROUGH if TOO_ROUGH in given else AGREES


def directions(params: Params, rng: np.random.Generator) -> dict[str, Array]:
    """Return a direction (n,) with largest entry 1 for each block, and one for all of them."""
    chosen: dict[str, Array] = {}
    groups: dict[str, list[slice]] = {}
    for path, part in params.slices.items():
        head, _, last = path.rpartition(".")
        groups.setdefault(head if last.isdigit() else path, []).append(part)
    for name, parts in groups.items():
        d = np.zeros(len(params.start))
        for part in parts:
            d[part] = rng.uniform(-1.0, 1.0, part.stop - part.start)
        chosen[name] = d / np.abs(d).max()
    if len(chosen) > 1:
        chosen[ALL] = rng.uniform(-1.0, 1.0, len(params.start))
    return chosen

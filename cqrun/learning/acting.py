"""The scene, controller and values of a simulation, from a scene file, a controller's file or a run directory.

A run directory gives its scene and its result: `controller.npz` of control and codesign, or result.json of sysid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cqrun.build.model import Built
from cqrun.errors import SceneError, UsageError
from cqrun.learning.agent import FILE, Agent
from cqrun.learning.replay import (
    IDENTIFIED,
    as_overrides,
    identified_in,
    kept_of_identified,
    learned_in,
    refuse_learned,
    require_fitting,
    substeps_in,
)
from cqrun.plugin.contract import Array
from cqrun.running.reporter import Reporter
from cqrun.running.runs import Source, scene_of
from cqrun.running.unknowns import make_params
from cqrun.scene.schema import Scene
from cqrun.store.result import LEARNED, RESULT
from cqrun.store.run import FINISHED, read_record
from cqrun.store.run_scene import stem_of


def acting_in(source: Path, overrides: Sequence[str], controller: Path | None, talk: Reporter) -> Source:
    """Return the scene and the result to simulate.

    Args:
        source: a scene file, or a run directory; the scene of a run of simulate, which learned nothing, is run again.
        controller: file of a controller that replaces that of the scene or of the run.

    Raises:
        SceneError, UsageError: bad input, or the run has found nothing.
    """
    trained, identified = controller, None
    if trained is None and source.is_dir():
        identified = _identified_by(source, talk)
        trained = _controller_of(source, talk) if identified is None else None
    unchanged, file, learned = _unchanged(source), trained or identified, dict[str, Array]()
    if trained is not None:
        learned = learned_in(trained)
    elif identified is not None:
        learned = identified_in(identified, unchanged or scene_of(source, ()))
    if file is not None:
        refuse_learned(file, learned, unchanged, overrides)
    overrides = [*_standing_goals(unchanged), *overrides]
    scene = scene_of(source, overrides)
    if file is not None:
        same_step = [] if trained is None else _same_substeps(trained, scene, talk)
        scene = scene_of(source, [*as_overrides(file, learned, scene), *same_step, *overrides])
    files = {name: file for name, file in ((FILE, trained), (IDENTIFIED, identified)) if file is not None}
    return Source(stem_of(source), scene, files)


def _same_substeps(controller: Path, scene: Scene, talk: Reporter) -> list[str]:
    """Return an override that keeps the number of substeps of a controller's training if the scene has `auto`.

    `auto` depends on the bounds of unknowns, which another scene may not have. Warn if the scene gives another number.
    """
    learned, here = substeps_in(controller), scene.time.substeps
    if learned in (None, here):
        return []
    if here == "auto":
        return [f"time.substeps={learned}"]
    talk.warn(
        f"{controller}: was trained with time.substeps={learned}, and this scene has {here}: bodies may be a little "
        "softer or stiffer than in the training"
    )
    return []


def _unchanged(source: Path) -> Scene | None:
    """Return the scene without overrides, or None if it is not valid; errors are reported for the overridden scene."""
    try:
        return scene_of(source, ())
    except (SceneError, UsageError):
        return None


def _standing_goals(scene: Scene | None) -> list[str]:
    """Return overrides for one episode with fixed goals, so that other overrides may move the goals anywhere."""
    goals = {} if scene is None else scene.goals
    drawn = [f"goals.{name}.spread=null" for name, goal in goals.items() if goal.spread is not None]
    return [*drawn, "episodes.count=1", "episodes.unseen=0", "episodes.fresh=false"] if drawn else []


def _controller_of(run: Path, talk: Reporter) -> Path | None:
    """Return the file of a run's controller; None for a run of simulate without; UsageError if another has none."""
    record, file = read_record(run), run / FILE
    if not file.is_file():
        if record.get("job") == "simulate":
            return None
        why = "no iteration is finished" if record.get("job") in LEARNED else f"it is a run of {record.get('job')}"
        raise UsageError(
            f"{run}: has no trained controller ({why}): `cqrun simulate RUN` replays a run of control, codesign or "
            "sysid; to run a scene give its file"
        )
    if record["status"] not in FINISHED:
        talk.phase("the run is not finished: its best controller so far is used")
    return file


def _identified_by(run: Path, talk: Reporter) -> Path | None:
    """Return the file with the result of a run of sysid, or its copy in a replay; None for other runs."""
    record = read_record(run)
    if record.get("job") != "sysid":
        return run / IDENTIFIED if (run / IDENTIFIED).is_file() else None
    status, why = record["status"], f": {record['reason']}" if record.get("reason") else ""
    if status == "failed" or not (run / RESULT).is_file():
        raise UsageError(f"{run}: has identified nothing to replay ({status}{why}); to run its scene give the file")
    if status not in FINISHED:
        talk.phase("the run is not finished: its values so far are used")
    return run / RESULT


def identified_values(built: Built, identified: Path | None) -> dict[str, Array]:
    """Return by path the identified values that cannot be in the scene: those per group or particle, and of shapes."""
    if identified is None:
        return {}
    values = kept_of_identified(identified, built.scene, built.particles)
    require_fitting(identified, values, make_params(built))
    return values


def make_agent(built: Built, trained: Path | None, talk: Reporter) -> Agent | None:
    """Return the agent that drives a scene's actuators; None without a controller.

    Terms of the objective and constraints that do not fit the run are removed with a warning: recorded motions and key
    frames may not cover its duration, and nothing is learned here.

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
        scene, unfit = built.scene, [problem.path.split(".")[:2] for problem in error.problems]
        if not all(len(place) == 2 and place[0] in ("objective", "constraints") for place in unfit):
            raise
        for problem in error.problems:
            talk.warn(f"{problem}: this run ignores it")
        rest = {
            section: {name: term for name, term in getattr(scene, section).items() if [section, name] not in unfit}
            for section in ("objective", "constraints")
        }
        return make_agent(replace(built, scene=scene.model_copy(update=rest)), trained, talk)

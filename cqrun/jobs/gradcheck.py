"""`cqrun gradcheck`: the adjoint of a scene's own loss against differences, direction by direction.

A direction d moves one block of values (one unknown; for many numbers, a random direction), or all of them. Central
differences D(h) = (f(x + h d) - f(x - h d)) / 2h are taken over a scan of steps and extrapolated to fourth order,

    E(h) = (16 D(h/4) - D(h)) / 15.

Large steps err by curvature, small ones by rounding; in between lies a plateau. It is found without looking at the
adjoint, where E changes least from one step to the next for its size, and there the two must agree. Where a branch
changes between the points (contact, stick and slip) the plateau begins at smaller steps, so the scan goes on below its
usual end while rounding is far off. Where there is none, differences are too rough to tell right from nearly right.

With data the loss is that of the fit, its unknowns in scaled coordinates (bounds are 1 apart). With a controller and
an objective it is that of the first episode, by the controller's parameters as they are, and the unknowns. Without, it
is a random linear function of the final state, by every number of the scene that gradients reach.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from cqrun.build.model import Built
from cqrun.design.params import Params
from cqrun.errors import RolloutError, RunError
from cqrun.fitting.cases import Case, given_cases, made_cases
from cqrun.jobs.checked_losses import Loss, episode_loss, fit_loss, state_loss
from cqrun.learning.agent import Agent
from cqrun.learning.episodes import EpisodeProblem, has_episodes
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.running.gradient_memory import gradient_plan
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import (
    build_and_warn,
    finished_already,
    open_run,
    raise_if_failed,
    refuse_overrides,
    require_same_data,
    saved_scene,
)
from cqrun.running.threads import cores
from cqrun.scene.load import load_scene
from cqrun.store.result import Direction, GradcheckResult, Verdict, write_result
from cqrun.store.run import RunDirectory

ALL_STEPS = 1e-2 * 4.0 ** -np.arange(19)
"""Steps of the central differences in scaled coordinates, 1e-2 to 1e-13."""

STEPS = ALL_STEPS[:11]
"""Those that are always taken, down to 1e-8."""

TOLERANCE = {"float64": 1e-5, "float32": 5e-2}
"""Largest relative difference on the plateau."""

NOISE = 100.0
"""Rounding errors of the loss that count as noise."""

ROUGH = 1e-4
"""Largest relative scatter of a plateau within which adjoint and differences count as equal."""

MOST = 10.0
"""Times the root of the precision, the largest part of the loss that can be rounding."""

FAR = 3.0
"""Times a plateau's scatter beyond which an adjoint is wrong, however rough the differences are."""

AGREES: Final = "agrees"
FLAT: Final = "flat"
TOO_ROUGH: Final = "too rough"
DISAGREES: Final = "disagrees"
TOLD: dict[Verdict, str] = {
    AGREES: "",
    FLAT: "flat: nothing to compare",
    TOO_ROUGH: "TOO ROUGH TO TELL",
    DISAGREES: "DISAGREES",
}
"""Verdicts, and what the table says."""

SUMMARY: dict[Verdict, str] = {
    AGREES: "adjoint and differences agree",
    TOO_ROUGH: "differences are too rough to tell whether the adjoint is right",
    DISAGREES: "adjoint and differences disagree",
}

ALL = "all together"


def run_gradcheck(
    source: Path | str,
    overrides: Sequence[str],
    out: Path | str,
    *,
    fresh: bool = False,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> tuple[Path, bool]:
    """Check a scene's gradient; return the run's directory and whether all directions agree.

    Raises:
        SceneError, UsageError: bad input. RunError: the scene blows up at its start. Stopped: asked to stop.
    """
    source, out = Path(source), Path(out)
    talk = reporter or Silent()
    built = build_and_warn(load_scene(source, overrides), talk)
    gradient_plan(built)
    n_threads = cores(threads)
    with_data = has_data(built)
    cases = given_cases(built) if with_data else None
    episodes = _episodes(built, n_threads)
    with open_run(
        source.stem, built.scene, out, job="gradcheck", threads=n_threads, fresh=fresh, with_data=with_data
    ) as run:
        if finished_already(run, talk):
            return run.path, run.status == "done"
        return check_gradient(run, built, cases, episodes, n_threads, talk)


def resume_gradcheck(run: RunDirectory, overrides: Sequence[str], threads: int, talk: Reporter) -> Path:
    """Do a check that was stopped again, from its beginning.

    Raises:
        RunError: adjoint and differences disagree.
    """
    refuse_overrides(run, overrides)
    if not run.finished:
        built = build_and_warn(saved_scene(run), talk)
        if has_data(built):
            require_same_data(run)
        cases = given_cases(built) if has_data(built) else None
        check_gradient(run, built, cases, _episodes(built, threads), threads, talk)
    return raise_if_failed(run)


def has_data(built: Built) -> bool:
    """Say whether a scene has a fit to differentiate."""
    scene = built.scene
    return scene.data is not None and bool(scene.unknowns) and not has_episodes(scene) and scene.controller is None


def _episodes(built: Built, threads: int) -> EpisodeProblem | None:
    return EpisodeProblem(Agent(built), threads=threads) if has_episodes(built.scene) else None


def check_gradient(
    run: RunDirectory, built: Built, cases: list[Case] | None, episodes: EpisodeProblem | None, threads: int,
    talk: Reporter,
) -> tuple[Path, bool]:  # fmt: skip
    """Check every direction; write the result."""
    compile_kernels([built, *(case.built for case in cases or [])], talk, adjoint=True)
    run.begin(threads)
    if has_data(built) and cases is None:
        talk.phase("making data")
        cases = made_cases(run, built)
    try:
        if episodes is not None:
            loss = episode_loss(episodes)
        else:
            loss = state_loss(built, threads) if cases is None else fit_loss(built, cases, threads)
        value, gradient = loss.value_and_grad(loss.x)
    except (RolloutError, TrialFailed) as error:
        run.finish("failed", f"at the start itself: {error}")
        raise RunError(f"{run.path}: at the start itself: {error}") from error
    talk.phase(f"checking {len(loss.params.blocks)} blocks by {2 * len(STEPS)} rollouts each")
    chosen = directions(loss.params, np.random.default_rng(built.scene.seed))
    rows: list[Direction] = []
    for number, (block, d) in enumerate(chosen.items()):
        if talk.stop.asked:
            run.finish("stopped", f"stopped after {number} of {len(chosen)} directions")
            raise talk.stop.stopped(f"{run.record['reason']}; `cqrun resume {run.path}` starts again")
        talk.advance(number, len(chosen), f"{number} of {len(chosen)} directions, now {block}")
        rows.append(check_direction(block, loss, value, gradient, d, built.scene.precision))
    agrees, steps = all(row.agrees for row in rows), ALL_STEPS[: max(len(row.scan) for row in rows)].tolist()
    write_result(run.path, GradcheckResult(agrees=agrees, loss=value, of=loss.words, steps=steps, rows=rows))
    run.finish("done" if agrees else "failed", SUMMARY[_worst(row.verdict for row in rows)])
    return run.path, agrees


def _worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the verdict on all directions together."""
    held = set(verdicts)
    return DISAGREES if DISAGREES in held else TOO_ROUGH if TOO_ROUGH in held else AGREES


def directions(params: Params, rng: np.random.Generator) -> dict[str, Array]:
    """Return a direction (n,) with its largest entry 1 for each block, and one through all of them."""
    found: dict[str, Array] = {}
    groups: dict[str, list[slice]] = {}
    for path, part in params.slices.items():
        head, _, last = path.rpartition(".")
        groups.setdefault(head if last.isdigit() else path, []).append(part)
    for name, parts in groups.items():
        d = np.zeros(len(params.start))
        for part in parts:
            d[part] = rng.uniform(-1.0, 1.0, part.stop - part.start)
        found[name] = d / np.abs(d).max()
    if len(found) > 1:
        found[ALL] = rng.uniform(-1.0, 1.0, len(params.start))
    return found


def check_direction(block: str, loss: Loss, value: float, gradient: Array, d: Array, precision: str) -> Direction:
    """Return what differences along one direction say of the gradient (n,)."""
    adjoint, count = float(gradient @ d), int(np.count_nonzero(d))
    eps, large = float(np.finfo(precision).eps), float(max(abs(value), loss.scale))
    rounding = NOISE * eps * large
    scan = extrapolated(lambda h: _central(loss, d, h), rounding)
    floor = max(rounding, rounding_alone(scan, MOST * eps**0.5 * large)) / ALL_STEPS[: len(scan)]
    best = plateau(scan, floor)
    differences, step = float(scan[best]), float(ALL_STEPS[best])
    noise = max(float(floor[best]), scatter(scan, best))
    shown = [float(e) if np.isfinite(e) else None for e in scan]
    found = Direction(
        block=block, count=count, adjoint=adjoint, differences=None, error=None, step=step, noise=noise, scan=shown,
        verdict=DISAGREES, agrees=False,
    )  # fmt: skip
    if not np.isfinite(differences):
        return found
    size, off = max(abs(adjoint), abs(differences)), abs(adjoint - differences)
    error = off / size if size > 0 else 0.0
    found.differences, found.error = differences, error
    if size <= floor[best]:
        found.verdict = FLAT
    elif error <= TOLERANCE[precision] or off <= noise <= ROUGH * size:
        found.verdict = AGREES
    elif noise > ROUGH * size and (off <= FAR * noise or noise > max(float(floor[best]), abs(differences))):
        found.verdict = TOO_ROUGH
    found.agrees = found.verdict in (AGREES, FLAT)
    return found


def _central(loss: Loss, d: Array, h: float) -> float:
    try:
        return (loss.value(loss.x + h * d) - loss.value(loss.x - h * d)) / (2.0 * h)
    except (RolloutError, TrialFailed):
        return float("nan")  # this step is too long for the scene; a shorter one serves


def extrapolated(central: Callable[[float], float], rounding: float = np.inf) -> Array:
    """Return E(h) at every step but the last, NaN where a rollout failed.

    Args:
        central: the central difference D(h).
        rounding: error of the loss that is expected; while its part in E is small and there is no plateau, steps go on.
    """
    D = [central(float(h)) for h in STEPS]
    scan = _of_fourth_order(D)
    for h in ALL_STEPS[len(STEPS) :]:
        if _settled(scan, rounding / ALL_STEPS[: len(scan)]):
            break
        D.append(central(float(h)))
        scan = _of_fourth_order(D)
    return scan


def _of_fourth_order(D: Sequence[float]) -> Array:
    return np.asarray((16.0 * np.array(D[1:]) - np.array(D[:-1])) / 15.0)


def _settled(scan: Array, floor: Array) -> bool:
    """Say whether smaller steps would tell no more: there is a plateau, or what changes is rounding, or they fail."""
    if not np.abs(np.diff(scan[-3:])).max() > floor[-1]:
        return True
    best = plateau(scan, floor)
    return bool(max(scatter(scan, best), float(floor[best])) <= ROUGH * abs(scan[best]))


def rounding_alone(scan: Array, most: float) -> float:
    """Return the loss's error, as seen, where a scan shows nothing else: E h is of one size everywhere; else 0.

    So it is where a loss saturates, with an error larger than `most`.
    """
    level = np.nan_to_num(np.abs(scan) * ALL_STEPS[: len(scan)])
    half = len(scan) // 2
    seen = 3.0 * float(level[half:].max())
    return seen if level[:half].max() <= seen <= most else 0.0


def plateau(scan: Array, floor: Array | float = 0.0) -> int:
    """Return where a scan changes least to both its neighbours, for its size; `floor` is what rounding makes of it."""
    change, floor = np.abs(np.diff(scan)), np.broadcast_to(floor, scan.shape)[1:-1]
    both = np.maximum(np.maximum(change[1:], change[:-1]), floor)
    size = np.maximum(np.abs(scan[1:-1]), floor)
    relative = np.divide(both, size, out=np.where(both == 0, 0.0, np.inf), where=size > 0)
    return 1 + int(np.nanargmin(relative)) if np.isfinite(relative).any() else len(scan) - 1


def scatter(scan: Array, best: int) -> float:
    """Return how far a scan's plateau is from its neighbours: no smaller difference can be told from it."""
    change = np.abs(np.diff(scan[max(0, best - 1) : best + 2]))
    return float(np.nanmax(change)) if np.isfinite(change).any() else 0.0


def lines_of(result: GradcheckResult) -> list[str]:
    """Return the table of a check."""
    width = max(len(row.block) for row in result.rows)
    lines = [f"gradient of {result.of} = {result.loss:.6g}"]
    lines.append(f"{'block':{width}}  numbers  {'adjoint':>14}  {'differences':>14}  {'error':>8}  {'step':>8}")
    for row in result.rows:
        head = f"{row.block:{width}}  {row.count:7d}  {row.adjoint:14.7e}"
        if row.differences is None:
            lines.append(f"{head}  every step's rollout failed: DISAGREES")
        else:
            told = TOLD[row.verdict]
            lines.append(f"{head}  {row.differences:14.7e}  {row.error:8.1e}  {row.step:8.1e}  {told}".rstrip())
    lines.append(SUMMARY[_worst(row.verdict for row in result.rows)].replace("disagree", "DISAGREE"))
    return lines

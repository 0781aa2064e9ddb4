"""Section: a paragraph on the methods, with the numbers of the run, for a paper."""

from __future__ import annotations

from collections.abc import Iterator

from cqrun.build.volumes import averages
from cqrun.errors import UsageError
from cqrun.figures.quantities import labels
from cqrun.report.blocks import Block, Text
from cqrun.report.subject import MISSING, Subject
from cqrun.report.words import clipped, count, sentence, short, some
from cqrun.scene.schema import Scene
from cqrun.store.result import GradcheckResult, LearnedResult, RestResult, Search, SysidResult
from cqrun.store.thinnest import Thinnest

OPTIMIZERS = {
    "least_squares": "nonlinear least squares (a trust-region method)",
    "lbfgs": "L-BFGS",
    "adam": "Adam",
    "sgd": "stochastic gradient descent",
    "cma_es": "CMA-ES",
    "slsqp": "sequential least-squares programming (SLSQP)",
    "sqp": "sequential quadratic programming",
    "trust_constr": "a trust-region interior-point method",
    "augmented_lagrangian": "an augmented Lagrangian method",
}
"""Optimizers in the words of a paper; others have the name of their plug-in."""


def methods(subject: Subject) -> Iterator[Block]:
    """Yield two paragraphs: the simulation, and what the job did with it."""
    yield Text(" ".join(_simulation(subject)))
    if words := " ".join(_work(subject)):
        yield Text(words)


def _simulation(subject: Subject) -> Iterator[str]:
    scene = subject.run.scene
    version, engine = subject.fact("versions", "cqrun"), subject.fact("engine")
    name = (
        "cqrun" + ("" if version == MISSING else f" {version}") + ("" if engine == MISSING else f" (engine {engine})")
    )
    verb = "was found" if subject.run.job == "rest" else "was simulated"
    what = "equilibrium" if subject.run.job == "rest" else "motion"
    yield (
        f"The {what} {verb} with {name}, a differentiable implementation of the moving least squares material point "
        f"method (MLS-MPM; Hu et al., 2019). {FRAMES[scene.world.frame]}"
    )
    yield _grid(subject)
    if subject.run.job == "rest":
        yield "Equilibria were found by Newton's method with preconditioned conjugate gradients."
    else:
        yield _steps(subject)
    if averages(scene):
        yield "Volume changes were averaged over the corners of cells, so that incompressible material does not lock."


FRAMES = {
    "reference": "The total Lagrangian form was used: displacements live on the nodes of a grid that follows the rest "
    "shape, and the weights are those of the rest shape.",
    "updated": "The updated Lagrangian form with affine particle-in-cell transfers (APIC) was used, as in the "
    "ChainQueen papers: particles carry the motion, and the grid is reset after each substep.",
}


def _grid(subject: Subject) -> str:
    scene = subject.run.scene
    bodies = "body" if len(scene.bodies) == 1 else "bodies"
    laws = sentence(sorted({body.material.elastic.name.replace("_", "-") for body in scene.bodies.values()}))
    plane = " in plane strain" if scene.dim == 2 else ""
    particles = _particles(subject)
    of = f"{particles:,} particles" if particles else "particles"
    verb = "was" if bodies == "body" else "were"
    words = (
        f"The {bodies} ({laws} elasticity{plane}) {verb} represented by {of} on a {scene.dim}D grid with cells of "
        f"{short(1e3 * scene.world.dx)} mm"
    )
    parts: dict[str, Thinnest] = getattr(subject.run.result, "thinnest", {})
    if parts:
        name, least = min(parts.items(), key=lambda entry: entry[1].cells)
        words += f". The thinnest part of {clipped(name, 60)}, {short(1e3 * least.thickness)} mm, has "
        words += f"{_of(least.cells, 'cell')} and {_of(least.particles, 'particle')} across it"
    return f"{words}. Numbers were {'double' if scene.precision == 'float64' else 'single'} precision."


def _of(number: float, what: str) -> str:
    """Return a number of things, which need not be whole."""
    return f"{number:.2g} {what}" + ("" if f"{number:.2g}" == "1" else "s")


def _particles(subject: Subject) -> int:
    """Return the number of particles in the run's trajectory; 0 without one."""
    if not subject.run.has_trajectory():
        return 0
    try:
        with subject.run.frames() as frames:
            return sum(part.stop - part.start for part in frames.bodies.values())
    except UsageError:
        return 0


def _steps(subject: Subject) -> str:
    time = subject.run.scene.time
    found = subject.run.result
    substeps = found.substeps if isinstance(found, Search) and found.substeps else time.substeps
    words = (
        f"A motion lasted {short(time.duration)} s, in {time.control_steps:,} control steps of "
        f"{short(1e3 * time.control_step)} ms"
    )
    if isinstance(substeps, int):
        step = short(1e6 * time.control_step / substeps)
        return f"{words} with {substeps} explicit substeps each ({step} µs, symplectic Euler)."
    return f"{words}, each with as many explicit substeps (symplectic Euler) as the stiffness needs."


def _work(subject: Subject) -> Iterator[str]:
    result = subject.run.result
    if isinstance(result, SysidResult):
        yield from _fit(subject, result)
    elif isinstance(result, LearnedResult):
        yield from _learning(subject.run.scene, result)
    elif isinstance(result, RestResult):
        residuals = [p.residual for p in result.points if p.converged]
        if residuals:
            yield (
                f"{len(residuals)} {'equilibrium was' if len(residuals) == 1 else 'equilibria were'} found. The net "
                f"force is at most {max(residuals):.0e} of the loads."
            )
    elif isinstance(result, GradcheckResult):
        yield (
            f"The gradient of the {result.of} by the adjoint was compared with finite differences along "
            f"{count(len(result.rows), 'direction')}, each with {len(result.steps)} step sizes."
        )


def _fit(subject: Subject, result: SysidResult) -> Iterator[str]:
    scene = subject.run.scene
    if scene.predicts_only:
        yield f"{_data(scene)[:1].upper()}{_data(scene)[1:]} were predicted. Nothing was fitted to them."
        return
    numbers = sum(len(u.value) if isinstance(u.value, list) else 1 for u in result.unknowns.values())
    many = numbers > 1
    names = some((clipped(_lower(name), 60) for name in labels(list(result.unknowns), scene.dim)), 6)
    yield (
        f"{numbers:,} unknown{'s' * many} ({names}) {'were' if many else 'was'} fitted to {_data(scene)} by "
        f"{_optimizer(scene)} in {count(result.iterations, 'iteration')}."
    )
    if any(u.interval is not None for u in result.unknowns.values()):
        yield (
            "The 95 % intervals are from the linearised least-squares problem at the solution. They allow for errors "
            "that are correlated in time and shared by markers. They do not contain the error of the model."
        )
    if held := [name for name, error in (result.recordings or {}).items() if error.holdout]:
        yield f"The fit did not use {some(held)}, which served as a test."


def _lower(name: str) -> str:
    """Return a name inside a sentence: names of people keep their capital letter."""
    return name if "'s " in name else name[:1].lower() + name[1:]


def _data(scene: Scene) -> str:
    if scene.synthetic is not None:
        return f"synthetic data with noise of {short(1e3 * scene.synthetic.noise)} mm (standard deviation)"
    if not scene.recordings:
        return f"an objective ({some(scene.objective)})"
    fitted = [r for r in scene.recordings.values() if not r.holdout] or list(scene.recordings.values())
    kinds = sentence(sorted({recording.measurement.name.replace("_", " ") for recording in fitted}))
    return f"{count(len(fitted), 'recording')} of {kinds}"


def _learning(scene: Scene, result: LearnedResult) -> Iterator[str]:
    controller = "the controller" if scene.controller is None else f"the controller ({scene.controller.name})"
    design = f" and {count(len(result.unknowns), 'unknown')} of the design" if result.unknowns else ""
    gradients = getattr(None if scene.optimizer is None else scene.optimizer.value, "gradients", False)
    by = ", with the gradient of the whole motion by the discrete adjoint" if gradients else ""
    yield (
        f"{controller[:1].upper()}{controller[1:]}{design} {'were' if design else 'was'} optimised by "
        f"{_optimizer(scene)} in {count(result.iterations, 'iteration')}{by}."
    )
    yield f"The objective was {some(scene.objective)}." if scene.objective else "There was no objective."
    if result.constraints:
        yield f"Constraints: {some(result.constraints)}."
    stages = result.stages()
    if "start" in stages and "trained" in stages:
        yield f"The loss changed from {short(stages['start'].loss)} to {short(stages['trained'].loss)}."


def _optimizer(scene: Scene) -> str:
    name = "" if scene.optimizer is None else scene.optimizer.name
    return OPTIMIZERS.get(name, name.replace("_", " ") or "an optimizer")

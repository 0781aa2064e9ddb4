"""Report what a fit takes as known, and which values it would find otherwise.

An interval covers only the noise of the data. The fitted values also depend on the bounds, on the substep, and on
material parameters that the scene holds fixed. Each of these is changed once, and the unknowns follow to first order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from cqrun.build.check_grid import CELLS
from cqrun.build.thickness import thinnest_parts
from cqrun.explain import listed
from cqrun.fitting.identifiability import FLAT, Unknown, follow
from cqrun.fitting.problem import FitProblem
from cqrun.fitting.uncertainty import AT_BOUND, Uncertainty
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.scene.keypath import split_own
from cqrun.scene.unknowns import truths
from cqrun.store.result import HeldNumber

RATIO, PART = 0.1, 0.1
"""Assumed errors of what a scene holds fixed: of a Poisson's ratio, and of any other number relative to itself."""

ROUNDING = 1e-6
"""Relative error of a thickness in cells."""

SLOW, ENOUGH = 0.8, 20
"""Errors are told to be no noise if so much of their square changes slowly, in at least so many pairs of frames."""

INWARD = 0.01
"""Distance from its bound at which the effect of an unknown is tested, in scaled coordinates."""


def held_numbers(problem: FitProblem) -> dict[str, tuple[float, float]]:
    """Return the value of each density and elastic constant that no unknown or recording sets, and another value.

    With synthetic data, only those are returned whose true value is another one.
    """
    scene = problem.cases[0].built.scene
    set_by = [path for block in problem.params.blocks for path in (block.path, *(f.path for f in block.followers))]
    set_by = [split_own(path)[1] for path in set_by]
    set_by += [path for recording in scene.recordings.values() for path in recording.overrides]
    true = truths(scene)
    held = {}
    for path, value in _material_numbers(problem):
        is_right = scene.synthetic is not None and true.get(path, value) == value
        if not is_right and not any(f"{path}.".startswith(f"{other}.") for other in set_by):
            held[path] = value, _otherwise(path, value)
    return held


def _material_numbers(problem: FitProblem) -> Iterator[tuple[str, float]]:
    """Yield path and value of the density and of every elastic constant of all bodies."""
    for name, body in problem.cases[0].built.scene.bodies.items():
        base, elastic = f"bodies.{name}.material", body.material.elastic
        yield f"{base}.density", float(body.material.density)
        for field in elastic.value.parameters:  # type: ignore[attr-defined]  # a law, by its kind
            yield f"{base}.elastic.{elastic.name}.{field}", float(getattr(elastic.value, field))


def _otherwise(path: str, value: float) -> float:
    """Return another value that is possible for a number that was not measured carefully."""
    if path.endswith(".poissons_ratio"):
        return value + RATIO if value + RATIO < 0.46 else value - RATIO
    return (1.0 + PART) * value


# --- sentences --------------------------------------------------------------------------------------------------------


def at_bounds(problem: FitProblem, x: Array, held: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    """Yield a sentence about each unknown that ended at a bound, with the likely cause."""
    causes = [f"{path} = {value:g}" for path, (value, _) in held.items()]
    wrong = f", such as one that the scene holds fixed ({listed(causes)})" if causes else ""
    best = "the best fit" if problem.cases[0].built.scene.data is not None else "the least objective"
    for block, part in zip(problem.params.blocks, problem.params.slices.values(), strict=True):
        scaled, several = x[part], part.stop - part.start > 1
        for end, reached, bound in (
            ("lower", scaled <= AT_BOUND, block.lower),
            ("upper", scaled >= 1.0 - AT_BOUND, block.upper),
        ):
            if not reached.any():
                continue
            which = f"{int(reached.sum())} of {len(scaled)} numbers of {block.path}" if several else block.path
            ended = f"{which} ended at {'their' if several else 'its'} {end} bound, {bound:g}"
            if not several and _does_nothing(problem, x, part.start):
                yield f"{ended}, but the data do not depend on it there: fix it, or add data that do"
            else:
                yield (
                    f"{ended}: {best} lies there or beyond. Widen the bound if such a value is possible; if not, "
                    f"another number is wrong{wrong}{_thin_on_the_grid(problem, block.path)}"
                )


def _thin_on_the_grid(problem: FitProblem, path: str) -> str:
    """Return a likely cause of a value at its bound: bodies too thin for the grid; empty if there are none.

    Synthetic data come from the same grid, which then is no cause.
    """
    built = problem.cases[0].built
    if built.scene.data is None or built.scene.synthetic is not None:
        return ""
    first, _, rest = split_own(path)[1].partition(".")
    own = rest.partition(".")[0] if first == "bodies" else ""
    thin = {
        name: part
        for name, part in thinnest_parts(built).items()
        if own in ("", name) and part.cells < CELLS * (1 - ROUNDING)
    }
    if not thin:
        return ""
    cells = {name: f"{part.cells:.2g}" for name, part in thin.items()}
    which = listed(f"'{name}' is {count} cell{'s' * (count != '1')} thick" for name, count in cells.items())
    damps = ", and the updated frame damps its motion" if built.scene.world.frame == "updated" else ""
    finest = min(part.thickness for part in thin.values()) / CELLS
    return f". A likely cause is the grid: {which}, and so bends too easily{damps}; fit with a dx of {finest:.3g} m"


def _does_nothing(problem: FitProblem, x: Array, k: int) -> bool:
    """Return whether the residuals stay the same if an unknown leaves its bound."""
    inside = x.copy()
    inside[k] += INWARD if x[k] < 0.5 else -INWARD
    try:
        here, there = problem.residuals_at([x, inside])
    except TrialFailed:
        return False
    return float(np.linalg.norm(there - here)) <= FLAT * float(np.linalg.norm(here))


def of_slow_errors(problem: FitProblem, residuals: Array) -> Iterator[str]:
    """Yield a sentence about each recording whose errors change slowly, as those of a model do and noise does not.

    Noise that is new in every frame has differences whose mean square is twice its own (von Neumann 1941).
    """
    if problem.cases[0].built.scene.synthetic is not None:
        return
    series, names = problem.series(), [case.name for case in problem.cases for _ in case.comparisons]
    for number, name in enumerate(names):
        square = difference = pairs = 0.0
        for each in (s for s in series if s.recording == number):
            errors, next_to = residuals[each.where], np.diff(each.frames) == 1
            square += float(np.sum(0.5 * (errors[1:] ** 2 + errors[:-1] ** 2)[next_to]))
            difference += float(np.sum((np.diff(errors) ** 2)[next_to]))
            pairs += int(next_to.sum())
        if pairs >= ENOUGH and 0.5 * difference < (1.0 - SLOW) * square:
            slow = 1.0 - 0.5 * difference / square
            yield (
                f"{name}: {slow:.0%} of its squared error changes slowly from frame to frame, so it is not noise: the "
                "model cannot follow the data there (its grid, law, clamp, or the calibration). The interval takes it "
                "for chance, and another model may give a value outside; `--resolution` shows what the grid does"
            )


def of_plane_strain(problem: FitProblem, unknowns: Sequence[Unknown]) -> Iterator[str]:
    """Yield a sentence about each Young's modulus that a 2D scene finds from measured data.

    In plane strain a beam bends like one of modulus E / (1 - nu^2), and one that is narrow across the plane like E.
    """
    scene, found = problem.cases[0].built.scene, {u.name: u.value for u in unknowns}
    if scene.dim != 2 or scene.synthetic is not None:
        return
    for path, value in found.items():
        law, _, name = path.rpartition(".")
        if name == "youngs_modulus":
            body = scene.bodies[split_own(path)[1].split(".")[1]]
            ratio = found.get(f"{law}.poissons_ratio", getattr(body.material.elastic.value, "poissons_ratio", 0.0))
            yield (
                f"{path}: 2D is plane strain, so it is that of a body which is wide across the plane. A beam that is "
                f"narrow there bends like this one if its modulus is about {value / (1.0 - ratio**2):.4g} Pa, the "
                "number here divided by 1 - nu^2"
            )


def of_the_substep(
    problem: FitProblem, x: Array, jacobian: Array, unknowns: Sequence[Unknown], uncertainty: Uncertainty
) -> Iterator[str]:
    """Yield sentences on values that half the substep would move out of their intervals.

    In the updated frame MLS-MPM smooths velocities in every substep, which softens and damps a body; so the fitted
    values depend on the number of substeps. `substeps: auto` takes more if bounds allow a stiffer material. The
    reference frame smooths nothing, synthetic data have no other substep, and bodies at rest have none at all.
    """
    scene, at_rest = problem.cases[0].built.scene, all(case.points for case in problem.cases)
    smooths = scene.world.frame == "updated"
    if not smooths or scene.synthetic is not None or len(jacobian) == 0 or at_rest:
        return
    try:
        residuals = problem.with_half_substep().residuals(x)
    except TrialFailed as failure:
        yield f"a rollout with half the substep and the identified values failed: {failure}"
        return
    for unknown, value in zip(unknowns, follow(jacobian, residuals, unknowns), strict=True):
        if _leaves(uncertainty.intervals[unknown.name], value):
            yield (
                f"{unknown.name}: half the substep would move it from {unknown.value:.4g} to about {value:.4g}, out of "
                "its interval, which covers only the noise of the data: compare values at equal `time.substeps`"
            )


def effects_of_held(
    problem: FitProblem,
    x: Array,
    jacobian: Array,
    unknowns: Sequence[Unknown],
    uncertainty: Uncertainty,
    held: Mapping[str, tuple[float, float]],
) -> dict[str, HeldNumber]:
    """Return what the fit would find, to first order, with another value of each fixed number, by its path."""
    if len(jacobian) == 0:
        return {}
    residuals = problem.residuals(x)
    size = float(np.linalg.norm(residuals))
    here = _coordinates(unknowns, follow(jacobian, residuals, unknowns))
    effects = {}
    for path, (value, other) in held.items():
        try:
            changed = problem.with_number(path, other).residuals(x)
        except TrialFailed:  # what cannot be simulated says nothing about the fit
            continue
        there = _coordinates(unknowns, follow(jacobian, changed, unknowns))
        moved = zip(unknowns, there - here, strict=True)
        left = changed + jacobian @ (there - _coordinates(unknowns, [u.value for u in unknowns]))
        effects[path] = HeldNumber(
            value=value,
            other=other,
            found={u.name: _moved(u, change) for u, change in moved if uncertainty.intervals[u.name] is not None},
            misfit=float(np.linalg.norm(left)) / size if size > 0 else None,
        )
    return effects


def _coordinates(unknowns: Sequence[Unknown], values: Iterable[float]) -> Array:
    return np.array([u.to_coordinate(value) for u, value in zip(unknowns, values, strict=True)])


def _moved(unknown: Unknown, change: float) -> float:
    """Return the value of an unknown after a change of its coordinate, within its bounds."""
    return unknown.from_coordinate(float(np.clip(unknown.coordinate + change, *unknown.ends)))


def of_held_numbers(
    effects: Mapping[str, HeldNumber], unknowns: Sequence[Unknown], uncertainty: Uncertainty
) -> Iterator[str]:
    """Yield a sentence about each fixed number whose assumed error would move an unknown out of its interval."""
    for path, held in effects.items():
        moved = [
            f"{u.name} about {held.found[u.name]:.4g} instead of {u.value:.4g}"
            for u in unknowns
            if u.name in held.found and _leaves(uncertainty.intervals[u.name], held.found[u.name])
        ]
        if moved:
            worse = "" if held.misfit is None else f", and its residuals would be {held.misfit:.2f} times as large"
            yield (
                f"{path} is held at {held.value:g}. With {held.other:g} the fit would find {listed(moved)}, outside "
                f"the interval{worse}: measure it, or make it an unknown"
            )


def without_intervals(held: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    """Yield a sentence about the numbers held fixed, for fits without intervals."""
    if held:
        numbers = listed([f"{path} = {value:g}" for path, (value, _) in held.items()])
        yield f"the scene holds {numbers} fixed, and the identified values are right only if these are"


def _leaves(interval: tuple[float, float] | None, value: float) -> bool:
    return interval is not None and not interval[0] <= value <= interval[1]

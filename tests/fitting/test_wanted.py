"""A fit to an objective: its loss is the objective's, its gradient the adjoint's; what it cannot take is refused."""

from __future__ import annotations

import numpy as np
import pytest
from small_beam import BEAM, E_PATH, FIT, SHEAR_PATH

import cqrun
from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.fitting.cases import given_cases
from cqrun.fitting.problem import FitProblem
from cqrun.jobs.sysid import SYSID
from cqrun.running.reporter import Silent
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene

THERE = "{track: {body: beam, keys: [[0.055, 0.07, 0.063]]}}"
UNKNOWNS = FIT[FIT.index("unknowns:") : FIT.index("optimizer:")]


def problem_of(objective: str, *overrides: str) -> FitProblem:
    built = build(load_scene(f"{BEAM}objective: {objective}\n{UNKNOWNS}", overrides))
    cases = given_cases(built)
    assert cases is not None
    return FitProblem(cases, make_params(built))


def test_the_loss_is_the_objectives():
    problem = problem_of(f"{{there: {THERE}, slow: {{rest: {{body: beam, weight: 2}}}}}}")
    losses, gradient = problem.losses_and_gradient(problem.values(problem.start))
    motion = cqrun.load(BEAM, threads=1).simulate()
    x, v = motion.x.mean(axis=1), motion.v.mean(axis=1)
    there = 0.5 * (x[5] + x[6]) + 0.01 / 8 * (v[5] - v[6])  # cubic Hermite, in the middle of a control step
    wanted = np.sum((there - [0.07, 0.063]) ** 2) + 2 * np.sum(v[-1] ** 2)
    assert losses["objective"] == pytest.approx(wanted, rel=1e-9)
    assert gradient.keys() == {E_PATH, SHEAR_PATH}


def test_its_gradient_is_that_of_its_value():
    problem = problem_of(f"{{there: {THERE}}}")
    x, step = problem.start, 1e-4
    value, gradient = problem.value_and_grad(x)
    assert value == pytest.approx(problem.value(x), rel=1e-12)
    for i, unit in enumerate(np.eye(len(x))):
        f = [problem.value(x + k * step * unit) for k in (1, -1, 2, -2)]
        assert gradient[i] == pytest.approx((8 * (f[0] - f[1]) - (f[2] - f[3])) / (12 * step), rel=1e-6)


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ("{mass: {body: beam}}", "objective.it: sysid takes only terms of the motion; `cqrun control` and"),
        ("{distance: {body: beam, axis: x}}", "objective.it: sysid takes only terms that are 0 at best, such as"),
        ("{reach: {body: beam, position: [0.1, 0.1], weight: -1}}", "objective.it: sysid takes only terms that are 0"),
        ("{track: {body: beam, keys: [[0.2, 0.1, 0.1]]}}", "objective.it: a key frame at 0.2 s is after the end of"),
    ],
)
def test_what_is_no_distance_of_a_motion_is_refused(term, message):
    with pytest.raises(SceneError) as info:
        problem_of(f"{{it: {term}}}")
    assert message in str(info.value)


def test_least_squares_are_for_data():
    scene = load_scene(f"{BEAM}objective: {{there: {THERE}}}\n{UNKNOWNS}optimizer: {{least_squares: {{}}}}\n")
    with pytest.raises(SceneError, match=r"least_squares: fits data by least squares; for an objective take lbfgs"):
        SYSID.prepare(scene, 1, Silent())

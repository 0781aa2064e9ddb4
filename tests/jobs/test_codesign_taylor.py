"""Taylor tests of a design: the objective and each constraint, through whole rollouts, by every kind of unknown.

The remainder |v(x + h d) - v(x) - h v'(x).d| falls as h^2 where v' is exact and no branch of contact changes.
"""

from __future__ import annotations

import numpy as np
import pytest
from small_finger import DESIGN

from cqrun.jobs.control import CODESIGN
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene

MATERIAL = "bodies.finger.material"
RATIO = f"{MATERIAL}.elastic.fixed_corotated.poissons_ratio"
UNKNOWNS = {
    "a stiffness a particle": "youngs_modulus",
    "a smooth Poisson's ratio": f"unknowns.{RATIO}={{bounds: [.1, .4], per: field, regulariser: .5}}",
    "a density a group, left = right": f"unknowns.{MATERIAL}.density={{bounds: [.5, 2], per: group, mirror: x}}",
    "its size": "unknowns.bodies.finger.place.scale={bounds: [.15, .2]}",
    "its pose": "unknowns.bodies.finger.place.angle={bounds: [-10, 10]}",
    "a part's size": "unknowns.bodies.finger.parts.tip.box.size.1={bounds: [.8, 1]}",
    "where a muscle lies": "unknowns.actuators.muscle.muscle.weight={bounds: [0, 1], per: field}",
    "a strength": "unknowns.actuators.muscle.muscle.strength={bounds: [1, 8], scale: log, regulariser: .5}",
    "a velocity": "unknowns.bodies.finger.velocity.0={bounds: [-1, 1]}",
    "a spin": "unknowns.bodies.finger.spin.0={bounds: [-5, 5]}",
}  # fmt: skip
OTHERS = [
    "bodies.finger.velocity=[0.1, 0.0]",
    "bodies.finger.place.angle=0",
    "actuators.muscle.muscle.weight=0.8",
    "boundaries.base=null",  # a body that turns and grows is not held where it stood
    "constraints.calm={of: {rest: {body: finger, particles: true}}, at_most: 1}",
    "constraints.weak={of: {effort: {}}, at_most: 1}",
    "constraints.whole={of: {stretch: {body: finger, power: 32}}, at_most: 2}",
    "constraints.heavy={of: {mass: {body: finger}}, at_most: 100}",
    "constraints.room={of: {volume: {body: finger}}, at_most: 1}",
    "constraints.stiff={of: {stiffness: {body: finger}}, at_most: 12}",
    "constraints.same={of: {unchanged: {body: finger}}, at_most: 1}",
    "constraints.narrow={of: {unchanged: {body: finger, of: poissons_ratio}}, at_most: 1}",
    "constraints.light={of: {unchanged: {body: finger, of: density}}, at_most: 1}",
]
STEPS = 0.004 * 0.5 ** np.arange(4)


@pytest.mark.parametrize("kind", UNKNOWNS)
def test_remainders_are_of_second_order(kind, rng):
    more = [] if kind == "a stiffness a particle" else ["unknowns={}", UNKNOWNS[kind]]
    problem = CODESIGN.prepare(load_scene(DESIGN, [*OTHERS, *more]), 1, Silent())
    here = problem.start + 0.05 * rng.standard_normal(problem.start.shape)
    x, way = np.clip(here, problem.lower + 0.1, problem.upper - 0.1), rng.standard_normal(here.shape)
    f, g, c, J = problem.gradients_and_constraints(x)
    value, slope = np.array([f, *c]), np.array([g @ way, *(J @ way)])
    remainders = []
    for h in STEPS:
        f, c = problem.values_and_constraints(x + h * way)
        remainders.append(np.abs(np.array([f, *c]) - value - h * slope))
    for name, *found in zip(["f", *problem.constraint_names], *remainders, strict=True):
        if found[0] > 1e-10:  # a function that is linear in these unknowns has no remainder
            assert np.log2(found[0] / found[-1]) / 3 >= 1.9, (name, found)
    assert np.max(remainders[0]) > 1e-6

"""Laws, fibres and branches through whole motions: the remainder of the loss is of second order in each parameter.

Seven small blocks stand side by side, each of another material. They are clamped below and swing in a strong wind of
gravity. One objective looks at all of them, so one gradient has the parameters of all materials.
"""

from __future__ import annotations

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.model import build
from cqrun.fitting.cases import make_cases
from cqrun.fitting.problem import FitProblem
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene

pytestmark = needs_jit

MATERIALS = {
    "mooney": "elastic: {mooney_rivlin: {c10: 1200, c01: 300, poissons_ratio: 0.45}}",
    "yeoh": "elastic: {yeoh: {c10: 1500, c20: -20, c30: 5, poissons_ratio: 0.45}}",
    "gent": "elastic: {gent: {mu: 3000, jm: 8, poissons_ratio: 0.45}}",
    "chains": "elastic: {arruda_boyce: {mu: 3000, lock: 2, bulk_modulus: 3.0e4}}",
    "ogden": "elastic: {ogden: {mu_1: 1500, alpha_1: 2.5, mu_2: -300, alpha_2: -3, poissons_ratio: 0.45}}",
    "relaxing": "elastic: {yeoh: {c10: 1200, c20: 10, c30: 2, poissons_ratio: 0.45}}, "
    "prony: {ratio_1: 0.4, time_1: 0.02, ratio_2: 0.3, time_2: 0.1}",
    "woven": "elastic: {mooney_rivlin: {c10: 1200, c01: 300, poissons_ratio: 0.45}}, "
    "fibre: {stiffness: 4000, directions: [[0.3, 1]]}",
}
NUMBERS = {
    "mooney": ["c10", "c01", "poissons_ratio"],
    "yeoh": ["c10", "c20", "c30", "poissons_ratio"],
    "gent": ["mu", "jm", "poissons_ratio"],
    "chains": ["mu", "lock", "bulk_modulus"],
    "ogden": ["mu_1", "alpha_1", "mu_2", "alpha_2", "poissons_ratio"],
    "relaxing": ["prony.ratio_1", "prony.time_1", "prony.ratio_2", "prony.time_2", "c10", "c20"],
    "woven": ["fibre.stiffness", "c01"],
}
STEPS = 0.01 * 0.5 ** np.arange(4)


def value(material: str, name: str) -> float:
    """Return the number of a parameter in the text of a material."""
    return float(material.split(f"{name.rpartition('.')[2]}: ")[1].split(",")[0].rstrip("}"))


def scene_of(frame: str) -> str:
    """Return the scene, with an unknown for every number: a tenth of its value away at most."""
    bodies, unknowns, objective = [], [], []
    for k, (name, material) in enumerate(MATERIALS.items()):
        left = 0.1 + 0.2 * k
        bodies.append(
            f"  {name}:\n    shape: {{box: {{corner: [{left:.2f}, 0.05], size: [0.06, 0.12]}}}}\n"
            f"    particles_per_cell: 4\n    material: {{density: 1000, {material}}}\n"
        )
        law = material.split("elastic: {")[1].partition(":")[0]
        for number in NUMBERS[name]:
            path = f"bodies.{name}.material.{number if '.' in number else f'elastic.{law}.{number}'}"
            low, high = sorted(value(material, number) * f for f in (0.9, 1.09))
            unknowns.append(f"  {path}: {{bounds: [{low}, {high}]}}\n")
        objective.append(f"  {name}: {{reach: {{body: {name}, position: [{left + 0.2:.2f}, 0.02]}}}}\n")
    return (
        f"cqrun: 1\nworld: {{size: [1.6, 0.4], dx: 0.02, gravity: [9, -6], frame: {frame}}}\n"
        f"bodies:\n{''.join(bodies)}"
        "boundaries:\n  floor: {sticky: {region: {box: {corner: [0, 0], size: [1.6, 0.07]}}}}\n"
        "time: {duration: 0.12, control_step: 0.02}\n"
        f"objective:\n{''.join(objective)}unknowns:\n{''.join(unknowns)}"
    )


@pytest.mark.parametrize("frame", ["reference", pytest.param("updated", marks=pytest.mark.slow)])
def test_remainders_are_of_second_order(frame, tmp_path, rng):
    (tmp_path / "blocks.yaml").write_text(scene_of(frame))
    built = build(load_scene(tmp_path / "blocks.yaml"))
    problem = FitProblem(make_cases(built), make_params(built))
    x = problem.start + 0.1 * rng.uniform(-1, 1, problem.start.shape) * (problem.upper - problem.lower)
    f, gradient = problem.value_and_grad(x)
    begin = 0
    for name, numbers in NUMBERS.items():
        way = np.zeros_like(x)
        way[begin : begin + len(numbers)] = rng.uniform(0.5, 1, len(numbers)) * rng.choice([-1, 1], len(numbers))
        begin += len(numbers)
        along = gradient @ way
        assert abs(along) > 1e-7, name  # the loss sees them
        left = [abs(problem.value(x + h * way) - f - h * along) for h in STEPS]
        assert np.diff(np.log(left)).max() / np.log(0.5) > 1.9, (name, left)

"""Quantities in another unit than was meant are asked about; consistent units of any kind are not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import trimesh

from cqrun.build.check_units import unit_questions
from cqrun.build.model import build
from cqrun.build.particles import sample
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene

SCENES = Path(__file__).parents[2] / "scenes"


def scene(*overrides: str, **body: Any) -> Scene:
    material = {"density": 1000.0, "elastic": {"neo_hookean": {"youngs_modulus": 5e4, "poissons_ratio": 0.3}}}
    shape = {"box": {"corner": [0.02, 0.02], "size": [0.05, 0.02]}}
    world = {"size": [0.1, 0.1], "dx": 0.005, "gravity": [0.0, -9.81]}
    bodies = {"arm": {"shape": shape, "particles_per_cell": 4, "material": material, **body}}
    time = {"duration": 0.1, "control_step": 0.01}
    return load_scene({"cqrun": 1, "world": world, "bodies": bodies, "time": time}, overrides)


def asked(*overrides: str, **body: Any) -> list[str]:
    return [f"{problem.path}: {problem.message}" for problem in unit_questions(scene(*overrides, **body))]


DENSITY = "bodies.arm.material.density"
MODULUS = "bodies.arm.material.elastic.neo_hookean.youngs_modulus"


@pytest.mark.parametrize(
    ("density", "words"),
    [
        (1.07, "1.07 kg/m^3 is less than any foam has; is it in g/cm^3? then give 1070"),
        (9.99, "9.99 kg/m^3 is less than any foam has; is it in g/cm^3? then give 9990"),
        (1e-6, "1e-06 kg/m^3 is less than any foam has"),
        (1.07e6, "1.07e+06 kg/m^3 is more than any metal has; is it in g/m^3? then give 1070"),
    ],
)
@pytest.mark.parametrize("gravity", ["[0, -9.81]", "[9.8, 0]", "[0, -10]", "[0, 0]"])
def test_density_in_another_unit_is_asked_about(density: float, words: str, gravity: str) -> None:
    questions = asked(f"{DENSITY}={density}", f"world.gravity={gravity}")
    assert f"{DENSITY}: {words}" in questions


@pytest.mark.parametrize("density", [10, 1070, 30_000])
def test_possible_densities_are_not_asked_about(density: float) -> None:
    assert asked(f"{DENSITY}={density}") == []


def test_density_of_a_region_is_asked_about() -> None:
    other = {"tip": {"density": 2.0}}
    groups = {"tip": {"box": {"corner": [0.05, 0.02], "size": [0.02, 0.02]}}}
    (question,) = asked(material_of=other, groups=groups)
    assert question.startswith("bodies.arm.material_of.tip.density: 2 kg/m^3 is less than any foam has")


@pytest.mark.parametrize(
    "units",
    [
        (f"{DENSITY}=1", f"{MODULUS}=10", "world.gravity=[0, 0]"),  # none
        (f"{DENSITY}=1", f"{MODULUS}=500", "world.gravity=[0, -1.8]"),
        (f"{DENSITY}=1", f"{MODULUS}=5e4", "world.gravity=[0, -9.81]", "bodies.arm.unit_mass=true"),
        (f"{DENSITY}=1.07", f"{MODULUS}=5e5", "world.gravity=[0, -981]"),  # centimetre, gram, second
        (f"{DENSITY}=1.07e-9", f"{MODULUS}=0.05", "world.gravity=[0, -9810]", "world.size=[100, 100]"),  # mm, t, s
    ],
)
def test_consistent_units_of_any_kind_are_not_asked_about(units: tuple[str, ...]) -> None:
    assert asked(*units) == []


def test_lengths_in_millimetres_are_asked_about() -> None:
    size = {"box": {"corner": [20, 20], "size": [50, 20]}}
    assert asked("world.size=[100, 100]", "world.dx=5", shape=size) == [
        "world.size: the world is 100 x 100 m; are its lengths in millimetres? give them in metres",
        f"{MODULUS}: 5e+04 Pa is less than the body's weight per area, 1.962e+05 Pa (density x gravity x height), "
        "which will flatten it: check the units of the modulus, the density and the lengths",
    ]


def test_modulus_in_megapascals_is_asked_about() -> None:
    (question,) = asked(f"{MODULUS}=0.05")
    assert question.startswith(f"{MODULUS}: 0.05 Pa is less than the body's weight per area, 196.2 Pa")


def test_questions_are_warnings_of_a_scene_that_runs() -> None:
    warnings = [problem.path for problem in build(scene(f"{DENSITY}=1.07")).warnings]
    assert warnings == [DENSITY]


@pytest.mark.parametrize("file", sorted(SCENES.glob("*/*.yaml")), ids=lambda file: f"{file.parent.name}/{file.stem}")
def test_scenes_of_the_project_are_not_asked_about(file: Path) -> None:
    assert list(unit_questions(load_scene(file))) == []


# --- sizes --------------------------------------------------------------------------------------------------


def filled(tmp_path: Path, edge: float, at: Sequence[float] = (0.0, 0.0, 0.0), dx: float = 0.005, **mesh: Any) -> str:
    """Return the refusal of a scene of 0.1 m with a mesh of some size, and its middle at a place in the file."""
    part = trimesh.creation.box((edge, edge, 2 * edge))
    part.apply_translation(at)
    part.export(tmp_path / "part.stl")
    shape = {"mesh": {"file": str(tmp_path / "part.stl"), "offset": [0.05, 0.05, 0.05], **mesh}}
    with pytest.raises(SceneError) as info:
        sample(scene("world.size=[0.1, 0.1, 0.1]", f"world.dx={dx}", "world.gravity=[0, 0, 0]", shape=shape))
    return str(info.value)


def test_mesh_in_another_unit_is_asked_about_before_it_is_filled(tmp_path: Path) -> None:
    sizes = "is 20 x 20 x 40 m, but the world is 0.1 x 0.1 x 0.1 m"
    question = "; is its file in millimetres? then give `units: mm`"
    assert filled(tmp_path, 20.0) == f"scene: bodies.arm.shape: {sizes}{question}"
    assert filled(tmp_path, 10.0, scale=2.0) == f"scene: bodies.arm.shape: {sizes}{question}"
    assert filled(tmp_path, 2.0, units="cm", scale=10.0).endswith(question)
    assert filled(tmp_path, 2.0).endswith("; is its file in centimetres? then give `units: cm`")
    assert filled(tmp_path, 0.2).endswith("; is its file in inches? then give `units: in`")
    assert filled(tmp_path, 1e5).endswith("but the world is 0.1 x 0.1 x 0.1 m: check its unit")


def test_mesh_beside_the_world_is_asked_about_if_another_unit_brings_it_inside(tmp_path: Path) -> None:
    """It is no larger than twice the world."""
    message = filled(tmp_path, 0.09, offset=[0.0, 0.0, 0.0], at=[0.5, 0.5, 0.5], dx=0.002)
    assert message == (
        "scene: bodies.arm.shape: reaches from (0.455, 0.455, 0.41) to (0.545, 0.545, 0.59) m, but the world is 0.1 x "
        "0.1 x 0.1 m; is its file in inches? then give `units: in`"
    )
    assert "reaches z = 0.56" in filled(tmp_path, 0.09, units="in", at=[0.0, 0.0, 20.0], dx=0.002)


def test_mesh_far_smaller_than_a_cell_is_asked_about(tmp_path: Path) -> None:
    assert filled(tmp_path, 2e-5).endswith(
        "is 2e-05 x 2e-05 x 4e-05 m, but a cell of the grid is 0.005 m; is the world in millimetres? then give "
        "`scale: 1000`"
    )
    assert filled(tmp_path, 0.02, units="mm").endswith("; is its file in metres? then give `units: m`")


def test_box_in_millimetres_is_asked_about() -> None:
    shape = {"box": {"corner": [20, 20], "size": [50, 20]}}
    for sampling in ({"lattice": {}}, {"random": {"count": 100}}):
        count = {} if "lattice" in sampling else {"particles_per_cell": None}
        with pytest.raises(
            SceneError, match=r"arm\.shape: is 50 x 20 m, but the world .*millimetres\? then multiply by 0"
        ):
            sample(scene(shape=shape, sampling=sampling, **count))


def test_body_that_reaches_a_little_out_of_the_world_is_told_where() -> None:
    with pytest.raises(SceneError, match=r"reaches x = 0\.16"):
        sample(scene(shape={"box": {"corner": [0.02, 0.02], "size": [0.15, 0.02]}}))


# --- the plan -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "path", "cause"),
    [
        (
            ("time.duration=2e5",),
            "bodies.arm.material",
            "its largest stable substep is 0.000609 s, in a run of 200000 s",
        ),
        ((f"{MODULUS}=5e14", "time.duration=1"), "bodies.arm.material", "substep is 6.09e-09 s, in a run of 1 s"),
        (("time.substeps=20000000",), "time.substeps", "10 control steps of 20,000,000 substeps"),
        (
            ("time.duration=2e5", "time.control_step=1e-4"),
            "time.control_step",
            "2,000,000,000 control steps of 1 substeps",
        ),
    ],
)
def test_plan_of_too_many_substeps_is_an_error_with_its_cause(
    overrides: tuple[str, ...], path: str, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cqrun.build.particles.require_memory", lambda *_: None)  # their records may not fit either
    with pytest.raises(SceneError) as info:
        build(scene(*overrides))
    (problem,) = info.value.problems
    assert problem.path == path
    assert "substeps, more than 100,000,000: " in problem.message
    assert cause in problem.message


@pytest.mark.parametrize("modulus", [5e10, 5e24])  # too many substeps in the run, and in a control step
def test_refused_plan_asks_for_the_unit_that_may_have_caused_it(modulus: float) -> None:
    with pytest.raises(SceneError) as info:
        build(scene(f"{DENSITY}=1.07", f"{MODULUS}={modulus}", "time.duration=1000"))
    plan, question = info.value.problems
    assert plan.path == "bodies.arm.material"
    assert question.path == DENSITY
    assert question.message.endswith("is it in g/cm^3? then give 1070")

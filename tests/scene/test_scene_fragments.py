"""A scene takes its material from a card or a file; keys beside it override, and mistakes are explained."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cqrun.errors import SceneError
from cqrun.scene.fragments import cards, merged
from cqrun.scene.load import load_scene, resolve

SCENE = """\
cqrun: 1
world: {size: [0.16, 0.12], dx: 0.01}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.06], size: [0.1, 0.02]}}
    particles_per_cell: 4
    groups: {tip: {box: {corner: [0.1, 0.06], size: [0.02, 0.02]}}}
    material: MATERIAL
time: {duration: 0.02, control_step: 0.01}
"""
FRAGMENT = "# a comment\nelastic: {yeoh: {c10: 1.0e4, c20: 100.0, poissons_ratio: 0.49}}\nviscosity: {shear: 5.0}\n"


@pytest.fixture
def made(tmp_path: Path) -> Callable[..., dict]:
    """Return a function that gives the material of a resolved scene beside a file `soft.yaml`."""
    (tmp_path / "soft.yaml").write_text(FRAGMENT)
    file = tmp_path / "scene.yaml"

    def material(text: str, *overrides: str) -> dict:
        file.write_text(SCENE.replace("MATERIAL", text))
        return resolve(load_scene(file, overrides))["bodies"]["beam"]["material"]

    return material


def test_a_file_gives_the_law_and_its_terms(made):
    assert made("{file: soft.yaml, density: 1070}") == {
        "density": 1070.0,
        "elastic": {"yeoh": {"c10": 1e4, "c20": 100.0, "c30": 0.0, "poissons_ratio": 0.49}},
        "viscosity": {"shear": 5.0, "bulk": 0.0},
    }


def test_a_card_gives_the_law(made):
    (law,) = cards()["ecoflex_00_30"]["material"]["elastic"]
    found = made("{card: ecoflex_00_30, density: 1070}")
    assert found["elastic"][law].items() >= cards()["ecoflex_00_30"]["material"]["elastic"][law].items()


@pytest.mark.parametrize(
    ("beside", "key", "expected"),
    [
        ("poissons_ratio: 0.45", "poissons_ratio", 0.45),
        ("bulk_modulus: 1.0e6", "bulk_modulus", 1e6),
        ("elastic: {yeoh: {c10: 2.0e4}}", "c10", 2e4),
    ],
)
def test_keys_beside_it_override_values_of_the_law(made, beside, key, expected):
    law = made(f"{{file: soft.yaml, density: 1070, {beside}}}")["elastic"]["yeoh"]
    assert law[key] == expected
    assert law["c20"] == 100.0
    assert ("poissons_ratio" in law) != ("bulk_modulus" in law)


def test_another_law_and_other_terms_replace_those_of_the_file(made):
    other = "elastic: {neo_hookean: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}, viscosity: null"
    found = made(f"{{file: soft.yaml, density: 1070, {other}}}")
    assert found == {"density": 1070.0, "elastic": {"neo_hookean": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}}


def test_overrides_reach_into_it(made):
    found = made(
        "{file: soft.yaml, density: 1070}", "bodies.beam.material.elastic.yeoh.c10=3e4",
        "bodies.beam.material.viscosity.shear=7.0",
    )  # fmt: skip
    assert found["elastic"]["yeoh"]["c10"] == 3e4
    assert found["elastic"]["yeoh"]["c20"] == 100.0
    assert found["viscosity"]["shear"] == 7.0


def test_a_part_of_a_body_may_have_a_file_of_the_same_law(tmp_path, made):
    (tmp_path / "stiff.yaml").write_text(FRAGMENT.replace("1.0e4", "5.0e4"))
    text = "{file: soft.yaml, density: 1070}\n    material_of: {tip: {file: stiff.yaml}}"
    made(text)
    scene = load_scene(tmp_path / "scene.yaml")
    assert resolve(scene)["bodies"]["beam"]["material_of"]["tip"]["elastic"]["yeoh"]["c10"] == 5e4


def test_its_values_can_be_unknowns(tmp_path, made):
    made("{file: soft.yaml, density: 1070}")
    file = tmp_path / "scene.yaml"
    lines = ("job: codesign", "unknowns: {bodies.beam.material.elastic.yeoh.c10: {bounds: [1.0e3, 1.0e5]}}")
    file.write_text(file.read_text() + "\n".join(lines) + "\n")
    assert "bodies.beam.material.elastic.yeoh.c10" in load_scene(file).unknowns


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{card: ecoflex_00_50, density: 1070}", "there is no card of this name (did you mean 'ecoflex_00_30'?)"),
        ("{card: 3, density: 1070}", "must be the name of a card, is 3"),
        ("{file: none.yaml, density: 1070}", "none.yaml: cannot be read (No such file or directory)"),
        ("{file: soft.yaml, card: ecoflex_00_30, density: 1}", "names a card and a file: keep one"),
        ("{file: soft.yaml}", "bodies.beam.material.density: is missing: Density at rest"),
        ("{file: scene.yaml, density: 1070}", "is a scene; the file of a material has its terms"),
    ],
)
def test_a_mistake_is_explained_with_its_place(made, text, message):
    with pytest.raises(SceneError) as caught:
        made(text)
    assert message in str(caught.value)
    assert "scene.yaml:" in str(caught.value)


def test_a_file_that_is_no_yaml_is_refused_with_its_own_place(tmp_path, made):
    (tmp_path / "soft.yaml").write_text("elastic: {yeoh\n  c10: [\n")
    with pytest.raises(SceneError, match=r"soft\.yaml:\d+:\d+: this is not YAML"):
        made("{file: soft.yaml, density: 1070}")


def test_a_fragment_is_not_changed_by_what_is_beside_it():
    fragment = {"elastic": {"yeoh": {"c10": 1.0, "poissons_ratio": 0.49}}}
    merged(fragment, {"elastic": {"yeoh": {"c10": 2.0}}, "bulk_modulus": 3.0})
    assert fragment == {"elastic": {"yeoh": {"c10": 1.0, "poissons_ratio": 0.49}}}

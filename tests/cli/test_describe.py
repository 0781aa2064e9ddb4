"""`cqrun describe`: lists, pages, aliases and suggestions, for every plug-in."""

from __future__ import annotations

import re
from importlib.util import find_spec

import pytest

from cqrun.cli.describe import _lines, _sections
from cqrun.errors import UsageError
from cqrun.plugin.contract import field_unit
from cqrun.plugin.registry import FOLDERS, plugins
from cqrun.scene.schema import Scene

KINDS = [kind for kind, folder in FOLDERS.items() if find_spec(folder)]
PAGES = [(kind, name) for kind in KINDS for name in plugins(kind)]


def page(*words: str) -> str:
    return "\n".join(_lines(*words, *[None] * (2 - len(words))))


def test_without_arguments_it_lists_kinds():
    text = page()
    assert all(f"\n  {kind} " in text for kind in KINDS)


@pytest.mark.parametrize(("kind", "name"), PAGES)
def test_every_plugin_has_a_page(kind, name):
    text = page(kind, name)
    cls = plugins(kind)[name]
    assert cls.__doc__, "a plug-in without a docstring has no page"
    assert text.startswith(f"{kind}: {name}\n\n  {cls.__doc__.strip().splitlines()[0]}")
    for field, info in cls.model_fields.items():
        assert f"\n  {field}: " in text
        assert info.description, f"{field} has no description"
    assert f"{kind} {name}: " in page(kind)


def test_the_pages_of_a_fit_say_how_to_free_a_value_of_one_recording():
    recordings, unknowns = page("recordings"), page("unknowns")
    for text in (recordings, unknowns):
        assert "`data.recordings.NAME.overrides.PATH`" in text
    assert "offset: [m], a number for each dimension, optional, differentiable" in recordings
    assert "If every recording is `holdout: true`, nothing is fitted" in recordings


@pytest.mark.parametrize("name", ["viscosity", "fixed_corotated", "neo_hookean"])
def test_a_materials_page_says_what_it_is_in_2d(name):
    """The trace is divided by 3, and a thin beam is stiffer than E."""
    text = page(name)
    assert "plane strain" in " ".join(text.split())
    assert ("tr(d)/3" if name == "viscosity" else "E / (1 - nu^2)") in text


def test_a_page_shows_units_ranges_and_defaults():
    text = page("shape", "union")
    assert "scale: [1], number, > 0, default 1.0" in text
    assert "shapes: several of shape (cqrun describe shape), required" in text


def test_what_may_be_left_out_is_optional():
    filled = {
        "world": ("gravity",),
        "bodies": ("velocity", "spin"),
        "recordings": ("body",),
        "synthetic": ("body",),
    }
    for part, fields in filled.items():
        for name in fields:
            assert re.search(rf"^  {name}: .*, optional", page(part), re.M), (part, name)
    assert re.search(r"^  size: .*, required", page("world"), re.M)


def test_nested_lists_are_shown():
    assert "route: [m], list of list of number, optional" in page("actuator", "cable")
    assert re.search(r"markers: \[m\], name -> list of number, optional", page("synthetic"))
    assert "overrides: name -> value, optional" in page("recordings")


def test_a_name_without_its_kind_is_enough():
    assert page("ball") == page("shape", "ball")


def test_a_folder_means_all_its_kinds():
    assert page("geometry", "ball") == page("shape", "ball")
    listing = page("geometry")
    assert "shape ball: " in listing
    assert "sampling lattice: " in listing


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["shape", "bal"], "no shape is called 'bal' \\(did you mean 'ball'\\?\\)"),
        (["shpae"], "nothing is called 'shpae' \\(did you mean 'shape'\\?\\)"),
        (["capsul"], "did you mean 'capsule'"),
        (["ball", "box"], "nothing is called 'ball'"),
    ],
)
def test_a_misspelt_name_gets_a_suggestion(words, message):
    with pytest.raises(UsageError, match=message):
        page(*words)


@pytest.mark.parametrize("part", ["scene", "world", "bodies", "time", "data", "recordings", "unknowns", "constraints"])
def test_parts_of_a_scene_have_pages(part):
    text = page(part)
    assert text.startswith(f"scene: {part}\n\n  ")
    assert part in page().splitlines()[-1]


def test_a_misspelt_part_gets_a_suggestion():
    with pytest.raises(UsageError, match=r"nothing is called 'recordngs' .did you mean 'recordings'"):
        page("recordngs")


@pytest.mark.parametrize("section", Scene.model_fields)
def test_every_section_of_a_scene_can_be_described(section):
    """A section of plug-ins is their list, any other has a page."""
    text = page(section)
    assert re.match(r"scene: |(\w+) \w+: ", text), text
    assert f"`cqrun describe {section}`" not in text


@pytest.mark.parametrize(
    ("one", "section"),
    [("body", "bodies"), ("unknown", "unknowns"), ("recording", "recordings"), ("region", "regions")],
)
def test_one_of_several_is_described_like_all(one, section):
    assert page(one) == page(section)


def test_a_plugin_with_the_name_of_a_section_points_to_it():
    assert page("goal").startswith("observer: goal\n")
    assert page("goal").endswith("for the section `goals` of a scene: cqrun describe goals")
    assert "cqrun describe goals" not in page("observer", "goal")


def test_the_page_of_a_material_has_its_density_and_its_terms():
    text = page("material")
    assert "density: [kg/m^3]" in text
    assert "elastic neo_hookean: " in text
    assert "material_term viscosity: " in text


def test_a_field_is_found_on_the_page_of_its_section():
    with pytest.raises(
        UsageError, match="'spin' has no page of its own: it is a field, described by `cqrun describe bodies`"
    ):
        page("spin")


def test_the_page_of_units_has_the_unit_of_every_field():
    text = page("units")
    table = text[text.index("  quantity") : text.index("  Numbers can have an exponent")]
    parts = [*_sections().values(), *(plugins(kind)[name] for kind, name in PAGES)]
    units = {field_unit(part, field) for part in parts for field in part.model_fields} - {None}
    assert {"m", "Pa s", "kg/m^3"} <= units
    for unit in {unit for several in units for unit in several.split(", ")}:
        assert re.search(rf"[ ,]{re.escape(unit)}(,|  |\n)", table), unit
    assert "cqrun describe units" in page()


def test_the_page_of_units_converts_correctly():
    """Every `1 X = Y` is computed with the prefixes and units of SI."""
    units = {
        "mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "ms": 1e-3, "g": 1e-3, "kPa": 1e3, "MPa": 1e6, "N/mm^2": 1e6,
        "bar": 1e5, "psi": 0.45359237 * 9.80665 / 0.0254**2, "g/cm^3": 1e-3 / 1e-6, "mPa s": 1e-3, "mN": 1e-3,
        "N/mm": 1e3,
    }  # fmt: skip
    table = page("units").partition("units in 2D")[0]
    equations = re.findall(r"([\d.]+) ([A-Za-z][\w/^ ]*?) = ([\d.e+-]*\d)", table)
    seen = set()
    for number, unit, value in equations:
        assert float(value) == pytest.approx(float(number) * units[unit], rel=1e-4), (number, unit, value)
        seen.add(unit)
    assert seen == set(units)


def test_pages_say_when_a_recording_begins():
    first = "the first frame of a C3D or Vicon file is at 0"
    assert first in page("data")
    assert first in page("objective", "track")
    assert "Times in a C3D or Vicon file count from the first frame in the file" in page("measurement", "markers")

"""`cqrun describe`: lists, pages, aliases and suggestions, for every plug-in."""

from __future__ import annotations

import re
from importlib.util import find_spec

import pytest

from cqrun.cli.describe import _lines
from cqrun.errors import UsageError
from cqrun.plugin.registry import FOLDERS, plugins

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
    assert "route: [m], list of list of number, required" in page("actuator", "cable")
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
    with pytest.raises(UsageError, match=r"nothing is called 'recording' .did you mean 'recordings'"):
        page("recording")


def test_pages_say_when_a_recording_begins():
    first = "the first frame of a C3D or Vicon file is at 0"
    assert first in page("data")
    assert first in page("objective", "track")
    assert "Times in a C3D or Vicon file count from the first frame in the file" in page("measurement", "markers")

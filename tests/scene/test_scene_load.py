"""Scenes load from files, text and data; overrides merge; resolved scenes load as bit-for-bit identical scenes."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cqrun.errors import SceneError
from cqrun.scene.load import dump, load_scene, resolve

Refused = Callable[..., list[str]]


def test_a_scene_shows_every_default(beam: str) -> None:
    data = resolve(load_scene(beam))
    assert data["precision"] == "float64"
    assert data["memory"] == 64 * 2**20
    assert data["time"]["substeps"] == "auto"
    body = data["bodies"]["beam"]
    assert body["velocity"] == [0.0, 0.0]
    assert body["spin"] == [0.0]
    assert body["sampling"] == {"lattice": {}}
    assert body["material"]["viscosity"] == {"shear": 100.0, "bulk": 0.0}
    assert data["unknowns"]["bodies.beam.material.viscosity.shear"]["per"] == "body"
    assert "data" not in data


def test_gravity_is_zero_if_absent(beam: str) -> None:
    assert load_scene(beam.replace(", gravity: [0, -9.81]", "")).world.gravity == [0.0, 0.0]


def test_a_resolved_scene_loads_as_the_same_scene(beam: str) -> None:
    first = load_scene(beam, ["world.dx=0.0050000000000000001", "title='1e4'"])
    text = dump(resolve(first))
    again = load_scene(text)
    assert resolve(again) == resolve(first)
    assert dump(resolve(again)) == text
    assert resolve(load_scene(resolve(first))) == resolve(first)


def test_a_scene_knows_its_file_and_text(tmp_path: Path, beam: str) -> None:
    file = tmp_path / "beam.yaml"
    file.write_text(beam)
    scene = load_scene(str(file))
    assert scene.source == file
    assert scene.text == beam
    assert scene.resolve_path("a.csv") == tmp_path / "a.csv"
    assert scene.where("world.dx") == f"{file}:3:31"
    assert load_scene(beam).source is None
    assert load_scene(resolve(scene)).text == ""


def test_a_tilde_means_home_in_names_of_files(tmp_path: Path, beam: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    file = tmp_path / "beam.yaml"
    image = "bodies.beam.shape={image: {file: ~/a.png, width: 0.1, corner: [0.05, 0.04]}}"
    file.write_text(beam)
    scene = load_scene(file, [image])
    assert scene.resolve_path("~/a.csv") == tmp_path / "home" / "a.csv"
    assert scene.bodies["beam"].shape.value.path == tmp_path / "home" / "a.png"  # type: ignore[union-attr]
    assert scene.resolve_path("a~/b") == tmp_path / "a~" / "b"


def test_a_title_is_one_line(beam: str) -> None:
    text = beam.replace("title: a beam", "title: |\n  a  beam\n\n  of rubber\t!\n")
    assert load_scene(text).title == "a  beam of rubber !"
    assert load_scene(beam.replace("title: a beam", "title: 'a  beam '")).title == "a  beam "


def test_a_scene_is_frozen(beam: str) -> None:
    with pytest.raises(ValueError, match="frozen"):
        load_scene(beam).world.dx = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("time", "term"),
    [("", {"body": "beam", "position": [0.1, 0.05]}), (", time: 0.5", {"body": "beam", "keys": [[0.5, 0.1, 0.05]]})],
)
def test_a_target_is_refused_with_the_objective_to_write_in_its_place(beam: str, time: str, term: Any) -> None:
    with pytest.raises(SceneError, match="a target is an objective, not data: remove `data`") as info:
        load_scene(beam, [f"data={{target: {{position: [0.1, 0.05]{time}}}}}"])
    way_out = re.search(r"`objective: (\{.*\})`; `cqrun sysid` minimises it", str(info.value))
    assert way_out
    scene = load_scene(beam, ["data=null", f"objective={way_out[1]}"])
    assert scene.objective["there"].value.model_dump(include=set(term)) == term


def test_overrides_merge_in_order(beam: str) -> None:
    scene = load_scene(
        beam,
        [
            "world.gravity.1=-1e0",
            "time.duration=1",
            "time.duration=0.5",
            "loads={}",
            "bodies.beam.material.elastic={neo_hookean: {youngs_modulus: 1e3, poissons_ratio: 0.3}}",
            "unknowns={}",
            "unknowns.world.gravity.1={bounds: [-10, 0]}",
            "data.recordings.a={file: a.csv}",
        ],
    )
    assert scene.world.gravity == [0.0, -1.0]
    assert scene.time.control_steps == 50
    assert scene.bodies["beam"].material.elastic.name == "neo_hookean"
    assert list(scene.unknowns) == ["world.gravity.1"]
    assert scene.data is not None
    assert scene.data.recordings is not None
    assert scene.data.recordings["a"].body == "beam"
    assert scene.where("time.duration") == "-o time.duration=0.5"


def test_an_override_reaches_inside_a_key_with_dots(beam: str) -> None:
    path = "bodies.beam.material.viscosity.shear"
    scene = load_scene(beam, [f"unknowns.{path}.bounds.1=300", f"unknowns.{path}.initial=2"])
    assert scene.unknowns[path].bounds == [1.0, 300.0]
    assert scene.unknowns[path].initial == 2.0


def test_short_and_long_form_of_a_union_are_the_same_path(beam: str) -> None:
    box = "{box: {corner: [0.05, 0.04], size: [0.1, 0.02]}}"
    short = beam.replace(f"shape: {box}", f"shape: {{union: [{box}]}}")
    long = load_scene(short, ["bodies.beam.shape.union.shapes.0.box.size.0=0.05"])
    other = load_scene(short, ["bodies.beam.shape.union.0.box.size.0=0.05"])
    assert resolve(other) == resolve(long)
    assert resolve(long)["bodies"]["beam"]["shape"]["union"]["scale"] == 1.0
    with pytest.raises(SceneError, match=r"scene:7:57: bodies.beam.shape.union.shapes.0.box.size.0: must be"):
        load_scene(short.replace("[0.1, 0.02]", "[0, 0.02]"))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("world.dx", "world.dx: must be key.path=value"),
        ("world.dx=", "world.dx: must be key.path=value"),
        ("=3", "must be key.path=value"),
        ("world.dx=[1", "world.dx: this is not YAML: while parsing a flow sequence"),
        ("world.dx={a: 1, a: 2}", "a: this key is here twice"),
        ("world.dx=!!python/name:os.system x", "world.dx: the tag tag:yaml.org,2002:python"),
        ("world.dx=small", "world.dx: must be a number in m, is 'small'"),
        ("world.dx.x=1", "world.dx: must be a number in m, is a mapping"),
        ("world.dy=1", "world.dy: unknown key; keys here: size, dx, frame, volume, contact, gravity"),
        (
            "world={size: [1, 1], dx: 1,02}",
            "world.02: is a number after a comma: if the comma is decimal, write a point",
        ),
        ("wrld.dx=1", "wrld: unknown key (did you mean 'world'?)"),
        ("world.gravity.7=1", "world.gravity.7: there is no entry '7' in a list of 2; they count from 0"),
        ("world.gravity=[1, 2, 3]", "world.gravity: must have 2 entries in this 2D world, has 3"),
        ("time.control_step=0.4", "time.duration: 1.5 s is not a multiple of the control step 0.4 s"),
        ("memory=1YiB", "memory: must be an amount of memory such as 2GiB or 500MB, is '1YiB'"),
        (
            "bodies.beam.material.elastic.neo_hookean.youngs_modulus=1",
            "bodies.beam.material.elastic: must name exactly",
        ),
        ("unknowns.world.dx={bounds: [0.001, 1]}", "unknowns.world.dx: no gradient reaches it"),
    ],
)
def test_problems_of_overrides_name_the_override(override: str, message: str, refused: Refused) -> None:
    problems = refused("", "", override)
    assert problems[0].startswith(f"-o {override}: {message}")
    assert len(problems) == 1 or override.startswith("bodies.")


def test_a_long_override_is_named_by_its_beginning(refused: Refused) -> None:
    whole = f"unknowns={{{', '.join(f'loads.wind.strength.{k}: {{bounds: [1, 2]}}' for k in range(9))}}}"
    (first, *_) = refused("", "", whole)
    assert first.startswith(f"-o {whole[: len('unknowns=') + 57]}...: unknowns.")


def test_problems_name_the_file_or_the_override_that_caused_them(refused: Refused) -> None:
    problems = refused("dx: 0.005", "dx: 0", "time.duration=-1")
    assert problems == [
        "beam.yaml:3:31: world.dx: must be greater than 0, is 0",
        "-o time.duration=-1: time.duration: must be greater than 0, is -1",
    ]


def test_null_removes_a_named_part(beam: str) -> None:
    paths = list(load_scene(beam).unknowns)
    assert load_scene(beam, [f"unknowns.{paths[0]}=null"]).unknowns.keys() == set(paths[1:])
    assert not load_scene(beam, ["boundaries.clamp=null"]).boundaries
    assert not load_scene(beam, ["unknowns=null"]).unknowns  # a section, too
    group = "bodies.beam.groups.mine"
    added = f"{group}={{box: {{corner: [0, 0], size: [1, 1]}}}}"
    assert "mine" in load_scene(beam, [added]).bodies["beam"].groups
    assert "mine" not in load_scene(beam, [added, f"{group}=null"]).bodies["beam"].groups
    with pytest.raises(SceneError, match=r"-o loads.wind=null: loads.wind: cannot be removed: there is no 'wind'"):
        load_scene(beam, ["loads.air={damping: {rate: 1.0}}", "loads.wind=null"])

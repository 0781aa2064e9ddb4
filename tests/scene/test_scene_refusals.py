"""The errors of invalid scenes say what is wrong, where, and what would be right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene

Refused = Callable[..., list[str]]

CASES = {
    "misspelt key": (
        "density: 1070",
        "densty: 1070",
        [
            "beam.yaml:11:5: bodies.beam.material.density: is missing: Density at rest [kg/m^3]",
            "beam.yaml:12:7: bodies.beam.material.densty: unknown key (did you mean 'density'?); ",
        ],
    ),
    "misspelt key of a plug-in": (
        "poissons_ratio: 0.45",
        "poisson_ratio: 0.45",
        [
            "beam.yaml:14:9: bodies.beam.material.elastic.fixed_corotated.poissons_ratio: is missing",
            "beam.yaml:16:11: bodies.beam.material.elastic.fixed_corotated.poisson_ratio: unknown key (",
        ],
    ),
    "misspelt plug-in": (
        "fixed_corotated:",
        "fixed_corrotated:",
        [
            "beam.yaml:14:9: bodies.beam.material.elastic.fixed_corrotated: no elastic has this name "
            "(did you mean 'fixed_corotated'?); legal names: arruda_boyce, fixed_corotated, gent, mooney_rivlin, ",
        ],
    ),
    "misspelt term": (
        "viscosity:",
        "viscocity:",
        ["beam.yaml:17:7: bodies.beam.material.viscocity: unknown key (did you mean 'viscosity'?)"],
    ),
    "negative density": (
        "1070",
        "-1070",
        ["beam.yaml:12:16: bodies.beam.material.density: must be greater than 0, is -1070"],
    ),
    "wrong range": ("dx: 0.005", "dx: 0", ["beam.yaml:3:31: world.dx: must be greater than 0, is 0"]),
    "size of zero": (
        "size: [0.1, 0.02]",
        "size: [0.1, 0]",
        ["beam.yaml:7:53: bodies.beam.shape.box.size.1: must be greater than 0, is 0"],
    ),
    "nu of a half": (
        "0.45",
        "0.5",
        ["beam.yaml:16:27: bodies.beam.material.elastic.fixed_corotated.poissons_ratio: must be less than 0.5, is 0.5"],
    ),
    "nan": (
        "1070",
        ".nan",
        ["beam.yaml:12:16: bodies.beam.material.density: must be a finite number, is nan"],
    ),
    "inf": (
        "2e5",
        ".inf",
        ["beam.yaml:15:27: bodies.beam.material.elastic.fixed_corotated.youngs_modulus: must be a finite"],
    ),
    "inf by overflow": (
        "1070",
        "1e999",
        ["beam.yaml:12:16: bodies.beam.material.density: must be a finite number, is inf"],
    ),
    "text for a number": (
        "1070",
        "1070 kg",
        ["beam.yaml:12:16: bodies.beam.material.density: must be a number in kg/m^3, is '1070 kg'"],
    ),
    "yes for a number": (
        "1070",
        "true",
        ["beam.yaml:12:16: bodies.beam.material.density: must be a number in kg/m^3, is true"],
    ),
    "empty value": (
        "1070",
        "",
        ["beam.yaml:12:7: bodies.beam.material.density: must be a number in kg/m^3, is empty"],
    ),
    "duplicate key": (
        "  duration: 1.5",
        "  duration: 1.5\n  duration: 1",
        ["beam.yaml:22:3: time.duration: this key is here twice; the first is in line 21; keep one"],
    ),
    "unknown named twice": (
        "unknowns:",
        "unknowns:\n  bodies.beam.material.viscosity.shear: {bounds: [1, 4]}",
        ["beam.yaml:28:3: unknowns.bodies.beam.material.viscosity.shear: this key is here twice"],
    ),
    "odd power": (
        "viscosity: {shear: 100}",
        "viscosity: {shear: 100}\n      incompressibility: {power: 3}",
        ["beam.yaml:18:34: bodies.beam.material.incompressibility.power: 3 is odd"],
    ),
    "duration": (
        "1.5",
        "1.505",
        ["beam.yaml:21:13: time.duration: 1.505 s is not a multiple of the control step 0.01 s; the nearest is 1.5 s"],
    ),
    "short run": (
        "1.5",
        "0.001",
        ["beam.yaml:21:13: time.duration: 0.001 s is not a multiple of the control step 0.01 s"],
    ),
    "substeps": (
        "control_step: 0.01",
        "control_step: 0.01\n  substeps: atuo",
        ["beam.yaml:23:13: time.substeps: must be auto or a whole number from 1 on, is 'atuo'"],
    ),
    "log scale": (
        "bounds: [1, 400]",
        "bounds: [0, 400]",
        [
            "beam.yaml:27:51: unknowns.bodies.beam.material.viscosity.shear.bounds.0: "
            "a log scale needs bounds greater than 0, is 0"
        ],
    ),
    "bounds in the wrong order": (
        "bounds: [1, 400]",
        "bounds: [400, 1]",
        [
            "beam.yaml:27:42: unknowns.bodies.beam.material.viscosity.shear.bounds: "
            "the lower bound 400 must be less than the upper bound 1"
        ],
    ),
    "memory unit": ("64MiB", "64Mib", ["beam.yaml:4:9: memory: must be an amount of memory such as 2GiB"]),
    "no memory": ("64MiB", "0", ["beam.yaml:4:9: memory: must be greater than 0, is 0"]),
    "both spacings": (
        "particles_per_cell: 4",
        "particles_per_cell: 4\n    spacing: 0.001",
        [
            "beam.yaml:6:3: bodies.beam: must have exactly one of particles_per_cell, spacing; "
            "has particles_per_cell, spacing"
        ],
    ),
    "no spacing": (
        "particles_per_cell: 4",
        "unit_mass: true",
        ["beam.yaml:6:3: bodies.beam: must have exactly one of particles_per_cell, spacing; has none"],
    ),
    "spacing of random particles": (
        "particles_per_cell: 4",
        "particles_per_cell: 4\n    sampling: {random: {count: 9}}",
        ["beam.yaml:8:25: bodies.beam.particles_per_cell: has no meaning with random sampling"],
    ),
    "vector of another dimension": (
        "gravity: [0, -9.81]",
        "gravity: [0, 0, -9.81]",
        ["beam.yaml:3:38: world.gravity: must have 2 entries in this 2D world, has 3"],
    ),
    "deep vector of another dimension": (
        "{corner: [0, 0], size: [0.06, 0.1]}",
        "{corner: [0, 0, 0], size: [0.06, 0.1]}",
        ["beam.yaml:19:35: boundaries.clamp.sticky.region.box.corner: must have 2 entries in this 2D"],
    ),
    "spin of another dimension": (
        "particles_per_cell: 4",
        "particles_per_cell: 4\n    spin: [0, 0, 1]",
        ["beam.yaml:9:5: bodies.beam.spin: must have 1 entries in this 2D world, has 3"],
    ),
    "shape of another dimension": (
        "shape: {box: {corner: [0.05, 0.04], size: [0.1, 0.02]}}",
        "shape: {cylinder: {start: [0, 0], end: [1, 0], radius: 1}}",
        ["beam.yaml:7:13: bodies.beam.shape.cylinder: a cylinder needs a 3D world"],
    ),
    "face of another dimension": (
        "boundaries:",
        "boundaries:\n  wall: {sticky: {face: z_min}}",
        ["beam.yaml:19:25: boundaries.wall.sticky.face: a 2D world has no face z_min"],
    ),
    "world of one dimension": (
        "[0.2, 0.1]",
        "[0.2]",
        ["beam.yaml:3:9: world.size: must have at least 2 entries, has 1"],
    ),
    "name": ("  beam:", "  my-beam:", ["beam.yaml:6:3: bodies.my-beam: a name has letters, digits and _"]),
    "version": ("cqrun: 1", "cqrun: 2", ["beam.yaml:1:8: cqrun: must be 1, is 2"]),
    "no version": ("cqrun: 1\n", "", ["beam.yaml:1:1: cqrun: is missing: Version of the scene format"]),
    "no bodies": (
        "bodies:",
        "bodis:",
        ["beam.yaml:1:1: bodies: is missing", "beam.yaml:5:1: bodis: unknown key (did you mean 'bodies'?)"],
    ),
    "signal of no actuator": (
        "time:",
        "activation: {signals: {left: [0, 1]}}\ntime:",
        ["beam.yaml:20:24: activation.signals.left: there is no actuator 'left'; there are: none"],
    ),
    "no source of activation": (
        "time:",
        "activation: {}\ntime:",
        ["beam.yaml:20:1: activation: must have exactly one of signals, random; has none"],
    ),
    "list for a mapping": (
        "  beam:",
        "  other: [1]\n  beam:",
        ["beam.yaml:6:3: bodies.other: must be a mapping `key: value`, is [1]"],
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_scene(name: str, refused: Refused) -> None:
    old, new, messages = CASES[name]
    problems = refused(old, new)
    assert len(problems) == len(messages), problems
    for line, message in zip(problems, messages, strict=True):
        assert line.startswith(message)


def test_more_memory_than_the_machine_has(refused: Refused) -> None:
    total = psutil.virtual_memory().total
    (problem,) = refused("64MiB", str(total + 1))
    assert problem.startswith("beam.yaml:4:9: memory: asks for ")
    assert "but this machine has " in problem
    assert load_scene({**_plain(), "memory": total}).memory == total


def test_all_problems_are_reported_at_once_by_line_then_by_override(refused: Refused) -> None:
    problems = refused(
        "      density: 1070\n      elastic:\n        fixed_corotated:\n          youngs_modulus: 2e5",
        "      density: -1\n      elastic:\n        fixed_corotated:\n          youngs_modulus: much",
        "time.duration=-1",
        "world.dx=0",
    )
    assert [line.split(": ")[0] for line in problems] == [
        "beam.yaml:12:16",
        "beam.yaml:15:27",
        "-o time.duration=-1",
        "-o world.dx=0",
    ]


def test_a_missing_file_and_a_wrong_encoding_are_reported(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with pytest.raises(SceneError, match=r"run: the scene cannot be read: it is a directory; a scene is a YAML file"):
        load_scene(tmp_path / "run")
    (tmp_path / "run" / "run.json").write_text("{}")
    with pytest.raises(SceneError, match=r"it is the directory of a run; give the file of the scene that was run, or"):
        load_scene(tmp_path / "run")
    with pytest.raises(SceneError, match=r"none.yaml: the scene cannot be read: No such file"):
        load_scene(tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"title: \xe9\n")
    with pytest.raises(SceneError, match=r"latin.yaml:1:8: this is not UTF-8 text: it has the byte 0xe9 here; save"):
        load_scene(tmp_path / "latin.yaml")
    (tmp_path / "second.yaml").write_bytes("title: \N{EURO SIGN}\na: ".encode() + b"b\xe9\n")
    with pytest.raises(SceneError, match=r"second.yaml:2:5: this is not UTF-8 text"):
        load_scene(tmp_path / "second.yaml")
    (tmp_path / "wide.yaml").write_text("cqrun: 1\n", encoding="utf-16")
    with pytest.raises(SceneError, match=r"wide.yaml:1:1: this is UTF-16 text: save the scene as UTF-8"):
        load_scene(tmp_path / "wide.yaml")


def test_a_file_far_too_long_is_refused_without_reading_it(tmp_path: Path) -> None:
    (tmp_path / "long.yaml").write_text("a" * 4_000_000)
    with pytest.raises(SceneError, match=r"long.yaml:1:1: has more than 2,000,000 bytes; a scene has at most 500,000"):
        load_scene(tmp_path / "long.yaml")
    with pytest.raises(SceneError, match=r"zero:1:1: has more than 2,000,000 bytes"):
        load_scene(Path("/dev/zero"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "data: must have exactly one of recordings, synthetic; has none"),
        ({"target": {"position": [0, 0]}}, "data.target: a target is an objective, not data"),
        (
            {"target": {"position": [0.1, 0.05], "time": 0.5, "body": "beam"}},
            "write `objective: {there: {track: {body: beam, keys: [[0.5, 0.1, 0.05]]}}}`",
        ),
        ({"recordings": {"a": {"file": "a.csv", "marker": {}}}}, "unknown key (did you mean 'markers'?)"),
        ({"recordings": {"a": {"file": "a", "markers": {"tip": 3}}}}, "markers.tip: must be a list, is 3"),
        ({"recordings": {"a": {"file": "a", "markers": {"tip": ["x", 1]}}}}, "markers.tip.0: must be a number in m"),
        ({"recordings": {}}, "data.recordings: must have at least 1 entry, has 0"),
        ({"recordings": {"a": {"file": ""}}}, "data.recordings.a.file: string should have at least 1 char"),
        (
            {"recordings": {"a": {"file": "a", "units": "inch"}}},
            "units: must be 'm', 'cm' or 'mm', is 'inch'",
        ),
        ({"recordings": {"a": {"file": "a", "still": [1, 0]}}}, "still: must begin before it ends"),
        (
            {"recordings": {"a": {"file": "a", "body": "bean"}}},
            "there is no body 'bean' (did you mean 'beam'?)",
        ),
        (
            {"recordings": {"a": {"file": "a", "markers": {"M 1": [0, 0, 0]}}}},
            "markers.M 1: must have 2 entries",
        ),
        (
            {"recordings": {"a": {"file": "a", "overrides": {"world.dy": 1}}}},
            "overrides.world.dy: unknown key",
        ),
        (
            {"recordings": {"a": {"file": "a", "overrides": {"world.dx": -1}}}},
            "world.dx: must be greater than 0",
        ),
        (
            {"recordings": {"a": {"file": "a", "skip": 1.5}}},
            "data.recordings.a.skip: skips 1.5 s of a run of 1.5 s: nothing is left to compare",
        ),
        (
            {"synthetic": {"truth": {"world.dx": 1}, "tracked": 9}},
            "exactly one of every, key_frames; has none",
        ),
        ({"synthetic": {"truth": {"world.dx": 1}, "every": 9}}, "exactly one of markers, tracked; has none"),
        (
            {"synthetic": {"truth": {"world.dx": 0.1}, "every": 1, "tracked": 9}},
            "only a value that can be an unknown can have a truth",
        ),
        ({"synthetic": {"truth": {"world.dy": 1}, "every": 1, "tracked": 9}}, "'world' has no 'dy'"),
    ],
)
def test_bad_data(data: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as info:
        load_scene({**_plain(), "data": data})
    assert message in str(info.value)


def _plain() -> dict[str, Any]:
    material = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}
    body = {"shape": {"ball": {"center": [0.5, 0.5], "radius": 0.1}}, "spacing": 0.01, "material": material}
    return {
        "cqrun": 1,
        "world": {"size": [1, 1], "dx": 0.02, "frame": "updated"},
        "bodies": {"beam": body},
        "time": {"duration": 1.5, "control_step": 0.1},
    }


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"time.control_step": 0.005}, "all recordings share `time`"),
        ({"unknowns": {}}, "all recordings share `unknowns`"),
        ({"bodies.beam.material.density": 900}, "is fitted, as the unknown 'bodies.beam.material.density'"),
    ],
)
def test_overrides_without_effect_are_refused(overrides: dict[str, Any], message: str) -> None:
    data = {"recordings": {"a": {"file": "a", "overrides": overrides}}}
    unknowns = {"bodies.beam.material.density": {"bounds": [0.5, 2.0]}}
    with pytest.raises(SceneError) as info:
        load_scene({**_plain(), "data": data, "unknowns": unknowns})
    assert message in str(info.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("time.duration=1.0e+9", r"time.duration: the records of .* control steps need .* are free: use fewer"),
        ("data={synthetic: {truth: {world.gravity.1: -9.0}, copies: 2000000000, tracked: 9, every: 1}}",
         r"data.synthetic.copies: 2,000,000,000 recordings need .* are free: make fewer copies"),
    ],
)  # fmt: skip
def test_a_scene_that_does_not_fit_the_memory_is_refused(override: str, message: str) -> None:
    scene = load_scene(_plain(), [override])
    with pytest.raises(SceneError, match=message):
        build(scene)


def test_an_unknown_start_of_a_held_out_recording_is_refused() -> None:
    recording = {"file": "a.csv", "start": 0.1, "holdout": True, "markers": {"m": [0.1, 0.1]}}
    given = {"data": {"recordings": {"a": recording}}, "unknowns": {"data.recordings.a.start": {"bounds": [0, 1]}}}
    with pytest.raises(SceneError, match=r"unknowns.*the recording 'a' is held out, so nothing determines its start"):
        load_scene({**_plain(), **given})


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("tracked: 1000000", r"data.synthetic.tracked: tracks 1,000,000 particles, but the body 'beam' has only"),
        ("markers: {tip: [100.0, 0.1]}", r"data.synthetic.markers.tip: is .* m from the body 'beam', which is"),
    ],
)
def test_synthetic_data_away_from_the_body_are_refused(what: str, message: str) -> None:
    data = f"data={{synthetic: {{truth: {{world.gravity.1: -9.0}}, {what}, every: 1}}}}"
    with pytest.raises(SceneError, match=message):
        build(load_scene(_plain(), [data]))

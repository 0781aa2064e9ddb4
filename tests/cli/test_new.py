"""`cqrun new`: every scene and plug-in that it writes is valid as it is, and nothing is overwritten unasked."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from little_worlds import needs_jit
from made_swing import swing
from plugin_sandbox import sandbox

from cqrun.cli.new import What
from cqrun.jobs.new.files import TEMPLATES, scene_templates
from cqrun.plugin.registry import FOLDERS
from cqrun.store.formats.long_table import write_csv

SCENES = ["codesign", "control", "material", "rest", "simulate"]


@pytest.fixture(autouse=True)
def _sandbox() -> Iterator[None]:
    with sandbox():
        yield


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# --- scenes -----------------------------------------------------------------------------------------------------


def test_there_is_a_template_for_every_scene_and_plug_in():
    assert scene_templates() == SCENES
    assert {what.value for what in What} == {*SCENES, "sysid", "plugin"}
    assert {path.stem for path in (TEMPLATES / "plugins").glob("*.py")} == set(FOLDERS)
    assert {path.stem for path in (TEMPLATES / "plugins").glob("*.yaml")} == set(FOLDERS)


@pytest.mark.parametrize("kind", SCENES)
def test_every_scene_is_valid_without_a_warning(cqrun, tmp_path, kind):
    scene = tmp_path / "my arm.yaml"
    code, out, err = cqrun("new", kind, scene)
    assert code == 0, err
    assert f"written: {scene}" in out
    assert out.splitlines()[-1] == f"next: cqrun validate '{scene}'"
    text = scene.read_text()
    assert len(text.splitlines()) <= 50
    assert max(map(len, text.splitlines())) <= 130
    assert "my_scene" not in text
    assert text.count("#") > 5
    code, out, err = cqrun("validate", scene)
    assert code == 0, err
    assert "warning" not in out
    assert yaml.safe_load(text)["job"] == ("sysid" if kind == "material" else kind)


@needs_jit
def test_the_scene_of_rest_runs(cqrun, tmp_path):
    assert cqrun("new", "rest", tmp_path / "beam")[0] == 0
    code, out, err = cqrun("rest", tmp_path / "beam.yaml", "-q", "--threads", "1", "--out", tmp_path / "out")
    assert code == 0, err
    assert "6 points at rest" in out


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("kind", SCENES)
def test_every_scene_runs(cqrun, tmp_path, kind):
    assert cqrun("new", kind, tmp_path / "scene.yaml")[0] == 0
    job = "sysid" if kind == "material" else kind
    code, out, err = cqrun(job, tmp_path / "scene.yaml", "-q", "--threads", "1", "--out", tmp_path / "out")
    assert code == 0, err
    if kind == "material":  # the modulus with which the table was made
        found = float(re.search(r"youngs_modulus\s+(\S+)", out).group(1))
        assert found == pytest.approx(1.2e5, rel=0.01)


# --- plug-ins ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", FOLDERS)
def test_every_plug_in_is_valid_with_permission(cqrun, tmp_path, kind):
    code, out, err = cqrun("new", "plugin", kind, "blue_thing", "--out", tmp_path)
    assert code == 0, err
    assert out.splitlines()[-1] == f"next: cqrun validate {tmp_path}/blue_thing.yaml --allow-plugins"
    source, scene = ((tmp_path / f"blue_thing{ending}").read_text() for ending in (".py", ".yaml"))
    assert f'@plugin("{kind}", "blue_thing")\nclass BlueThing(' in source
    assert f"my_{kind}" not in source + scene
    assert len(scene.splitlines()) <= 50
    code, out, err = cqrun("validate", tmp_path / "blue_thing.yaml", "--allow-plugins")
    assert code == 0, err
    assert "warning" not in out
    assert cqrun("validate", tmp_path / "blue_thing.yaml")[0] == 2
    code, out, _ = cqrun("describe", kind, "blue_thing", "--plugin", tmp_path / "blue_thing.py")
    assert (code, out.splitlines()[0]) == (0, f"{kind}: blue_thing")


@pytest.mark.slow
@needs_jit
@pytest.mark.parametrize("kind", FOLDERS)
def test_every_plug_in_runs_and_its_gradient_is_right(cqrun, tmp_path, kind):
    assert cqrun("new", "plugin", kind, "blue_thing", "--out", tmp_path)[0] == 0
    scene = tmp_path / "blue_thing.yaml"
    words = (scene, "--allow-plugins", "-q", "--threads", "1", "--out", tmp_path / "out")
    code, _, err = cqrun(yaml.safe_load(scene.read_text())["job"], *words)
    assert code == 0, err
    if "gradcheck" in scene.read_text():
        code, out, err = cqrun("gradcheck", *words)
        assert code == 0, out + err


@needs_jit
def test_a_plug_in_without_kernels_runs(cqrun, tmp_path):
    assert cqrun("new", "plugin", "region", "stripes_of_mine", "--out", tmp_path)[0] == 0
    words = ("--allow-plugins", "-q", "--threads", "1", "--out", tmp_path / "out")
    code, _, err = cqrun("rest", tmp_path / "stripes_of_mine.yaml", *words)
    assert code == 0, err


def test_the_words_of_a_template_can_be_names(cqrun, tmp_path):
    for kind, name in (("shape", "shape"), ("objective", "bound_term"), ("elastic", "stress"), ("load", "my_load")):
        assert cqrun("new", "plugin", kind, name, "--out", tmp_path)[0] == 0
        assert cqrun("validate", tmp_path / f"{name}.yaml", "--allow-plugins")[0] == 0
    assert "class ShapePlugin(Shape):" in (tmp_path / "shape.py").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("elastik", "a"), "there is no kind of plug-in called 'elastik' (did you mean 'elastic'?); kinds: shape, "),
        (("elastic", "Soft Foam"), "'Soft Foam' cannot be the name of a plug-in: small letters, digits and _, "),
        (("elastic", "Soft Foam"), "such as soft_foam"),
        (("elastic", "../a"), "cannot be the name of a plug-in"),
        (("load", "for"), "'for' cannot be the name of a plug-in"),
        (("elastic", "neo_hookean"), "'neo_hookean' means something else for the kind elastic already"),
        (("measurement", "file"), "'file' means something else for the kind measurement already"),
        (("elastic",), "a plug-in needs its kind and a name, such as `cqrun new plugin elastic my_law`"),
    ],
)
def test_a_plug_in_that_cannot_be_is_refused(cqrun, tmp_path, words, message):
    code, out, err = cqrun("new", "plugin", *words, "--out", tmp_path)
    assert (code, out) == (2, "")
    assert message in err
    assert files(tmp_path) == set()


# --- files ------------------------------------------------------------------------------------------------------


def test_nothing_is_overwritten_unasked(cqrun, tmp_path):
    table = tmp_path / "test.csv"
    table.write_text("mine")
    code, out, err = cqrun("new", "material", tmp_path / "test.yaml")
    assert (code, out) == (2, "")
    assert err == f"error: {table}: is there already; choose another name, or overwrite it with --force\n"
    assert files(tmp_path) == {"test.csv"}
    assert table.read_text() == "mine"
    assert cqrun("new", "material", tmp_path / "test.yaml", "--force")[0] == 0
    assert table.read_text().startswith("extension_mm,force_N\n")
    code, _, err = cqrun("new", "control", tmp_path / "test.yaml")
    assert (code, "is there already" in err) == (2, True)


def test_a_link_is_not_overwritten(cqrun, tmp_path):
    (tmp_path / "law.py").symlink_to(tmp_path / "nowhere.py")
    assert cqrun("new", "plugin", "elastic", "law", "--out", tmp_path)[0] == 2
    assert files(tmp_path) == {"law.py"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("control", "arm.txt"), "arm.txt: the name of a scene ends in .yaml, not in '.txt'"),
        (("control", "."), ".: is a folder; name the file of the scene, such as beam.yaml"),
        (("control", ".."), "..: is a folder"),
        (("control", "a", "b"), "give one name for the scene, such as `cqrun new control my_control.yaml`"),
        (("sysid", "a"), "name the recording with --markers FILE"),
        (("rest", "a", "--markers", "b.csv"), "--markers belongs to `cqrun new sysid`, not to `cqrun new rest`"),
        (("rest", "a", "--size", "1,1"), "--size belongs to `cqrun new sysid`, not to `cqrun new rest`"),
        (("sysid", "a", "--markers", "b.csv", "--size", "10x2"), "--size 10x2: takes numbers in m with commas between"),
        (("sysid", "a", "--markers", "none.csv"), "none.csv: there is no such file"),
        (("sysid", "a", "--markers", "empty.csv"), "empty.csv: the file is empty"),
        (("sysid", "a", "--markers", "text.csv"), "text.csv:1: the first line must name the columns"),
        (("sysid", "a", "--markers", "binary.csv"), "binary.csv: "),
        (("sysid", "a", "--markers", "binary.c3d"), "binary.c3d: "),
        (("sysid", "a", "--markers", "text.doc"), "text.doc: the name of a recording ends in"),
    ],
)
def test_bad_usage_and_bad_files_end_with_a_message(cqrun, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "text.csv").write_text("hello\n")
    (tmp_path / "text.doc").write_text("hello\n")
    for name in ("binary.csv", "binary.c3d"):
        (tmp_path / name).write_bytes(np.random.default_rng(1).bytes(5000))
    before = files(tmp_path)
    code, out, err = cqrun("new", *words)
    assert (code, out) == (2, "")
    assert message in err
    assert files(tmp_path) == before


def test_a_scene_for_a_recording_is_written_with_what_to_check(cqrun, tmp_path):
    write_csv(swing(), tmp_path / "swing.csv")
    code, out, err = cqrun("new", "sysid", tmp_path / "fit", "--markers", tmp_path / "swing.csv")
    assert code == 0, err
    assert "6 markers: base_1, base_2, base_3, tip_1, tip_2, tip_3\n" in out
    assert "all markers at rest: 0 to 0.5" in out
    listed = re.findall(r"^  (\d)\. (.*)$", out, re.M)
    assert [int(k) for k, _ in listed] == list(range(1, 8))
    text = (tmp_path / "fit.yaml").read_text()
    for _, guess in listed[:4]:
        assert f"guess: {guess}" in text
    assert out.endswith(f"next: cqrun validate {tmp_path}/fit.yaml\n")
    assert cqrun("validate", tmp_path / "fit.yaml")[0] == 0
    again = cqrun("new", "sysid", tmp_path / "fit", "--markers", tmp_path / "swing.csv")
    assert (again[0], "is there already" in again[2]) == (2, True)


def test_templates_are_written_by_name_alone():
    """A template's own name is replaced wherever it stands, so nothing else may contain it."""
    for path in (TEMPLATES / "plugins").glob("*.py"):
        text = path.read_text()
        assert f'@plugin("{path.stem}", "my_{path.stem}")' in text
        assert f"--plugin my_{path.stem}.py" in text

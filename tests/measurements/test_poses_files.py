"""Poses: files and scenes that cannot be used, and what is asked about."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_arm import (
    LOADS,
    LOWER,
    MARKERS,
    POSES,
    POSES_OF,
    UPPER,
    E,
    markers_text,
    recording,
    scene_of,
    write_poses,
)
from small_beam import changed

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.fitting.cases import given_cases
from cqrun.fitting.problem import FitProblem
from cqrun.jobs.validate import validate
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the poses in the long form, and in the wide one in millimetres."""
    folder = tmp_path_factory.mktemp("poses")
    write_poses(folder / "poses.csv")
    write_poses(folder / "wide.csv", wide=True, unit="mm", seed=2)
    return folder


@pytest.fixture
def folder(data: Path, tmp_path: Path) -> Path:
    """Return a folder of the test's own with the recordings."""
    for file in data.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def problem_of(scene: Path, *overrides: str) -> FitProblem:
    built = build(load_scene(scene, overrides))
    cases = given_cases(built)
    assert cases is not None
    return FitProblem(cases, make_params(built))


HEAD = "pose,upper_N,lower_N,push_N,marker,x,y"
LINE = "a,0,0,0,tip,0.13,0.04"
STEM = "a,0,0,0,stem,0.1,0.07"

FILES: dict[str, tuple[str, str]] = {
    "no loads": (
        "pose,marker,x,y\na,tip,0.13,0.05\nb,tip,0.13,0.04",
        "bad.csv: the load 'upper_N' is not a column; it has pose, marker, x, y",
    ),
    "a misspelt load": (
        f"{HEAD.replace('upper_N', 'uper_N')}\n{LINE}",
        "bad.csv: the load 'upper_N' is not a column (did you mean 'uper_N'?); it has pose, uper_N,",
    ),
    "a load that nothing uses": (
        f"{HEAD},air_kPa\n{LINE},3\n{STEM},3",
        "bad.csv: the column air_kPa is neither a load nor a marker's position: if it is a load, name in `loads` what",
    ),
    "two loads in a pose": (
        f"{HEAD}\n{LINE}\na,5,0,0,stem,0.1,0.07",
        "bad.csv:3: pose 'a' has 0 and 5 as upper_N: all lines of a pose have the same loads",
    ),
    "a load that is no number": (
        f"{HEAD}\n{LINE.replace('a,0', 'a,zero')}",
        "bad.csv:2: upper_N is 'zero', which is not",
    ),
    "a load that is missing": (f"{HEAD}\n{LINE.replace('a,0', 'a,')}", "bad.csv:2: upper_N is empty: every line needs"),
    "a negative tension": (
        f"{HEAD}\n{LINE.replace('a,0', 'a,-4')}\n{STEM.replace('a,0', 'a,-4')}",
        f"data.recordings.arm.poses.loads.upper_N: {UPPER}: must be at least 0, is -4",
    ),
    "a marker twice": (f"{HEAD}\n{LINE}\n{LINE}\n{STEM}", "bad.csv:3: marker 'tip' is there twice in pose 'a'"),
    "no such marker": (f"{HEAD}\n{LINE}", "bad.csv: no marker 'stem'; it has tip"),
    "no positions": (
        "pose,upper_N,lower_N,push_N,marker\na,0,0,0,tip\na,0,0,0,stem",
        "bad.csv: has no positions: name",
    ),
    "no markers": (
        "pose,upper_N,lower_N,push_N,q\na,0,0,0,1",
        "bad.csv: has no markers: name them in a column `marker`",
    ),
    "a third axis": (f"{HEAD},z\n{LINE},0\na,0,0,0,stem,0.1,0.07,0", "bad.csv: has a column 'z', and the scene is 2D"),
    "no poses": (f"{HEAD}\n", "bad.csv: has a header but no data"),
    "an empty file": ("", "bad.csv: the file is empty"),
    "semicolons": ("pose;marker;x;y\na;tip;1;2", "bad.csv: its columns are not separated by commas"),
    "a short line": (f"{HEAD}\n{LINE}\na,0,0,0,stem,0.1", "bad.csv:3: 6 columns instead of 7; is the file truncated?"),
    "a column twice": (f"{HEAD},x\n{LINE},1", "bad.csv: the column 'x' is there 2 times: name each once"),
    "two columns of an axis": (
        f"{HEAD},x_mm\n{LINE},1\na,0,0,0,stem,0.1,0.07,1",
        "'x' and 'x_mm' are the same axis: keep",
    ),
    "millimetres": (
        f"{HEAD}\na,0,0,0,tip,130,40\na,0,0,0,stem,100,70",
        "the file looks as if it is in mm: say `units: mm`",
    ),
    "another origin": (
        f"{HEAD}\na,0,0,0,tip,0.63,0.34\na,0,0,0,stem,0.6,0.37",
        "positions are in the axes of the scene: give `offset` if the file has another origin",
    ),
    "a huge number": (f"{HEAD}\n{LINE.replace('0.13', '1e300')}\na,0,0,0,stem,0.1,0.07", "x is 1e300, which nobody"),
}


@pytest.mark.parametrize("name", FILES)
def test_files_that_cannot_be_used(name, folder):
    text, message = FILES[name]
    (folder / "bad.csv").write_text(text)
    with pytest.raises(SceneError) as error:
        problem_of(scene_of(folder, recording(file="bad.csv")))
    assert message in str(error.value)
    assert "data.recordings.arm" in str(error.value)


def test_a_file_without_loads_is_a_question_of_what_differs(folder):
    (folder / "plain.csv").write_text("pose,marker,x,y\na,tip,0.13,0.05\nb,tip,0.13,0.04\n")
    line = f"    arm: {{file: plain.csv, poses: {{markers: {{tip: {MARKERS['tip']}}}}}}}\n"
    with pytest.raises(SceneError) as error:
        problem_of(scene_of(folder, line))
    assert "plain.csv: has 2 poses, but `loads` names no column, so that the model is the same in all" in str(
        error.value
    )
    assert "such as `loads: {tension_N: actuators.left.cable.tension}`" in str(error.value)


SCENES: dict[str, tuple[str, str, str]] = {
    "the updated frame": (
        "frame: reference", "frame: updated",
        "world.frame: is `updated`, but the recording 'arm' (`poses`) is compared with bodies at rest, which only the "
        "reference frame has: set `world.frame: reference`",
    ),
    "half the precision": ("title:", "precision: float32\ntitle:", "precision: is `float32`, too coarse for"),
    "no clamp": (
        "  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.12]}}}}",
        "  wall: {slip: {region: {box: {corner: [0, 0], size: [0.04, 0.12]}}, normal: [1, 0]}}",
        "bodies.arm: nothing holds it: it can move in 1 way without resistance, so it has no place of rest; add",
    ),
    "a marker in the clamp": (
        "tip: [0.139, 0.06]", "tip: [0.022, 0.06]",
        "marker 'tip' is bound to a part of the body that is clamped, so the model cannot move it: correct its rest",
    ),
    "a load that does not exist": (
        UPPER, "actuators.uper.cable.tension", "loads.upper_N: actuators.uper.cable.tension: 'actuators' has no",
    ),
    "a load that is a shape": (UPPER, "bodies.arm.shape.box.size.0", "loads.upper_N: changes the rest shape of a body"),
    "no such actuator": (UPPER, "activation.uper", "loads.upper_N: there is no actuator 'uper'; the scene has upper"),
    "an activation beyond its limits": (
        UPPER, "activation.upper", "loads.upper_N: 60 is outside the actuator's limits, 0 to 1",
    ),
    "a cable that nothing activates": (
        "{upper: [1], lower: [1]}", "{lower: [1]}",
        f"loads.upper_N: '{UPPER}' does nothing, because the activation of 'upper' is 0 at rest: give `activation: ",
    ),
    "two columns for one load": (LOWER, UPPER, f"two columns of `loads` drive '{UPPER}': name it once"),
    "a load that is an unknown": (
        f"  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}", f"  {UPPER}: {{bounds: [0, 9]}}",
        f"loads.upper_N: its values are those of '{UPPER}', which the unknown '{UPPER}' sets: remove one of the two",
    ),
    "a time": ("file: poses.csv", "file: poses.csv, start: 0.1", "arm.start: has no meaning for the measurement"),
    "a length": ("file: poses.csv", "file: poses.csv, length: 0.1", "arm.length: has no meaning for the measurement"),
    "still frames": ("file: poses.csv", "file: poses.csv, still: [0, 1]", "arm.still: has no meaning for the"),
    "an unknown start": (
        f"  {E}: ", "  data.recordings.arm.start: {bounds: [0, 1]}\n" + f"  {E}: ",
        "unknowns.data.recordings.arm.start: has no meaning for the measurement `poses`: remove it",
    ),
    "three coordinates": ("tip: [0.139, 0.06]", "tip: [0.139, 0.06, 0]", "poses.markers.tip: must have 2 entries"),
    "no markers": (markers_text(), "{}", "poses.markers: must have at least 1"),
    "other units": (
        "file: poses.csv", "file: wide.csv, units: cm", "the column 'tip_x_mm' is in mm, and the scene says",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_scenes_that_do_not_fit(name, folder):
    old, new, message = SCENES[name]
    scene = changed(scene_of(folder, recording()), old, new)
    with pytest.raises(SceneError) as error:
        problem_of(scene)
    assert message in str(error.value)


def test_a_load_in_another_unit_is_asked_about(folder):
    text = (folder / "poses.csv").read_text()
    (folder / "poses.csv").write_text(text.replace("push_N", "push_mN"))
    scene = changed(scene_of(folder, recording()), "push_N:", "push_mN:")
    asked = (
        "arm: is the load 'push_mN' in mN? loads.push.point_force.force.1 is in the SI unit: give {path: loads.push."
    )
    assert any(asked in line for line in validate(scene))
    changed(
        scene,
        "push_mN: loads.push.point_force.force.1",
        "push_mN: {path: loads.push.point_force.force.1, factor: 0.001}",
    )
    assert not any("is the load" in line for line in validate(scene))
    (case,) = problem_of(scene).cases
    assert case.points[-1]["loads.push.point_force.force.1"] == pytest.approx(0.4e-3)


def test_the_loads_are_those_of_the_table(folder):
    (case,) = problem_of(scene_of(folder, recording())).cases
    assert [tuple(point[path] for path in LOADS.values()) for point in case.points] == list(POSES.values())
    assert POSES_OF.count(":") == len(LOADS)

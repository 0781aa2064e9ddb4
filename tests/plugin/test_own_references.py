"""A plug-in of one's own: what its fields refer to is found by their types, whatever the fields are called."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from little_worlds import needs_jit
from plugin_sandbox import sandbox
from small_beam import Listener, assert_same
from small_finger import FINGER

from cqrun.build.model import build
from cqrun.build.particles import sample
from cqrun.errors import SceneError, Stopped, UsageError
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.learning.agent import Agent
from cqrun.running.runs import open_run, run_scene
from cqrun.scene.load import load_scene, resolve
from cqrun.scene.plugin_files import plugins_allowed

GAUGE = '''\
"""A position against the one that was recorded."""

from typing import Annotated

import numpy as np
from pydantic import Field

from cqrun.loads.load import Load
from cqrun.observers.observer import BoundObserver, MomentBar, Observer
from cqrun.observers.rows import means
from cqrun.plugin.reference import BodyName, FileName, GroupName, NamesGroup, OnlyBodyName
from cqrun.plugin.registry import plugin


@plugin("observer", "gauge")
class Gauge(Observer):
    """Position of a centroid less a recorded one [m]."""

    carrier: BodyName = Field(description="Body that carries the gauge")
    hold: GroupName | None = Field(description="Group of that body", default=None)
    facing: BodyName | None = Field(description="Body in view", default=None)
    mark: Annotated[str, NamesGroup(of="facing")] | None = Field(description="Group in view", default=None)
    recording_path: FileName = Field(description="Recorded position")

    def bind(self, matter):
        recorded = np.loadtxt(self.path_of(self.recording_path))
        return Offset(means([matter.members(self.carrier, self.hold)], matter.n_particles), recorded)


class Offset(BoundObserver):
    """Centroid less what was recorded."""

    def __init__(self, rows, recorded):
        self.rows, self.recorded, self.size = rows, recorded, len(recorded)
        self.low, self.high = np.full(self.size, -1.0), np.full(self.size, 1.0)

    def observe(self, moment):
        return moment.x[0] - self.recorded, np.zeros(0)

    def observe_vjp(self, moment, z_bar, memory_next_bar):
        return MomentBar(x=z_bar[None])


@plugin("load", "ballast")
class Ballast(Load):
    """A mass [kg] on a body, read from a file."""

    shorthand = "table"
    lies_on: OnlyBodyName = Field(description="Body that it lies on")
    table: FileName = Field(description="File of its mass")

    def apply(self, fields, chosen):
        fields.mass[chosen] += float(np.loadtxt(self.path_of(self.table))) / len(chosen)
'''

TWO = FINGER.replace(
    "boundaries:\n",
    """\
  crate:
    parts: {lid: {box: {corner: [0.7, 0.7], size: [0.1, 0.1]}}}
    sampling: {lattice: {count: 2}}
    material: {density: 1, elastic: {fixed_corotated: {youngs_modulus: 10, poissons_ratio: 0.3}}}
boundaries:
""",
)
"""The small finger beside a crate."""


@pytest.fixture(autouse=True)
def _sandbox() -> Iterator[None]:
    with sandbox(), plugins_allowed():
        yield


def scene(folder: Path, gauge: str, text: str = FINGER) -> Path:
    """Return the small finger's scene with a gauge among its observers."""
    (folder / "gauge.py").write_text(GAUGE)
    record(folder, 0.4)
    path = folder / "finger.yaml"
    text = text.replace("title:", "plugins: [gauge.py]\ntitle:")
    path.write_text(text.replace("  clock: {clock: {}}\n", f"  gauge: {{gauge: {gauge}}}\n"))
    return path


def record(folder: Path, x: float) -> None:
    """Write a recorded position."""
    (folder / "rest.txt").write_text(f"{x} 0.5\n")


GOOD = "{carrier: finger, hold: tip, recording_path: rest.txt}"


@pytest.mark.parametrize(
    ("gauge", "told"),
    [
        ("{carrier: fingr, recording_path: rest.txt}", "carrier: there is no body 'fingr' (did you mean 'finger'?); "
         "there are: finger, crate"),
        ("{carrier: finger, hold: tpi, recording_path: rest.txt}", "hold: there is no group of the body 'finger' "
         "'tpi' (did you mean 'tip'?); there are: left, right, tip, above"),
        ("{carrier: finger, facing: crate, mark: tip, recording_path: rest.txt}", "mark: there is no group of the body "
         "'crate' 'tip'; there are: lid, above"),
    ],
)  # fmt: skip
def test_a_name_that_nothing_has_is_refused(gauge, told, tmp_path):
    above = "regions: {above: {box: {corner: [0, 0], size: [1, 1]}}}\n"
    path = scene(tmp_path, gauge, TWO.replace("actuators:", f"{above}actuators:"))
    key, _, message = told.partition(": ")
    with pytest.raises(SceneError) as info:
        load_scene(path)
    (line,) = str(info.value).splitlines()
    assert line.startswith(f"{path}:")
    assert line.endswith(f": observers.gauge.gauge.{key}: {message}")


def test_names_that_there_are_are_taken(tmp_path):
    path = scene(tmp_path, "{carrier: finger, hold: tip, facing: crate, mark: lid, recording_path: rest.txt}", TWO)
    assert load_scene(path).observers["gauge"].value.model_dump() == {
        "carrier": "finger", "hold": "tip", "facing": "crate", "mark": "lid", "recording_path": "rest.txt",
    }  # fmt: skip


def test_a_group_of_a_field_that_names_no_body_is_refused(tmp_path):
    path = scene(tmp_path, GOOD)
    (tmp_path / "gauge.py").write_text(GAUGE.replace('of="facing"', 'of="view"'))
    told = "class Gauge, observer 'gauge', has a group of the body that 'view' names, and no such field of the type "
    with pytest.raises(SceneError, match=f"{told}BodyName; fields of it: carrier, facing"):
        load_scene(path)


@pytest.mark.parametrize("ballast", ["{ballast: {table: mass.txt}}", "{ballast: mass.txt}"])
def test_the_only_body_is_filled_in(ballast, tmp_path):
    path = scene(tmp_path, GOOD)
    loaded = load_scene(path, [f"loads.extra={ballast}"])
    assert resolve(loaded)["loads"]["extra"]["ballast"] == {"table": "mass.txt", "lies_on": "finger"}
    path = scene(tmp_path, GOOD, TWO)
    with pytest.raises(SceneError, match=r"loads\.extra\.ballast\.lies_on: is missing"):
        load_scene(path, [f"loads.extra={ballast}"])


def test_a_file_is_read_from_the_scenes_folder(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    path = scene(tmp_path, GOOD)
    (tmp_path / "mass.txt").write_text("2.5\n")
    monkeypatch.chdir(tmp_path / "elsewhere")
    loaded = load_scene(path, ["loads.extra={ballast: mass.txt}"])
    built = build(loaded)
    assert built.assembly.inputs({}).fields.mass.sum() == pytest.approx(48.0 + 2.5)
    assert Agent(built).observation.observers[2].recorded.tolist() == [0.4, 0.5]


def test_what_a_file_holds_is_part_of_the_runs_name(tmp_path):
    path = scene(tmp_path, GOOD)
    named = [run_scene("finger", load_scene(path), job="control", with_data=False) for _ in range(2)]
    assert named[0].files == {"rest.txt": tmp_path / "rest.txt"}
    assert named[0].digest() == named[1].digest()
    before = named[0].digest()
    record(tmp_path, 0.41)
    assert named[0].digest() != before
    record(tmp_path, 0.4)
    assert named[0].digest() == before


def test_a_missing_file_is_told_with_its_key_path(tmp_path):
    path = scene(tmp_path, GOOD)
    built = build(load_scene(path))
    (tmp_path / "rest.txt").unlink()
    place = rf"finger\.yaml:\d+:\d+: observers\.gauge\.gauge\.recording_path: {tmp_path}/rest\.txt: cannot be read \(No"
    with pytest.raises(SceneError, match=place):
        Agent(built)
    with pytest.raises(SceneError, match=place):
        open_run("finger", built.scene, tmp_path / "out", job="control", threads=1, fresh=False)
    assert not (tmp_path / "out").exists()
    record(tmp_path, 0.4)
    with pytest.raises(SceneError, match=r"loads\.extra\.ballast\.table: .*mass\.txt: cannot be read \(No such file"):
        sample(load_scene(path, ["loads.extra={ballast: mass.txt}"]))


def test_a_missing_file_of_a_term_is_told_and_a_simulation_goes_without_the_term(tmp_path):
    path = scene(tmp_path, GOOD)
    talk = Listener()
    follow = "objective.follow={track: {body: finger, marker: {file: away.csv, marker: tip}}}"
    run = run_simulate(path, ["time.duration=0.01", follow], tmp_path / "out", threads=1, reporter=talk)
    (warning,) = [text for text in talk.said if "away.csv" in text]
    assert f"objective.follow.track.marker.file: {tmp_path / 'away.csv'}: cannot be read" in warning
    assert warning.endswith(": this run ignores it")
    assert (run / "trajectory.h5").is_file()


@needs_jit
def test_a_run_does_not_go_on_with_another_file(tmp_path):
    path, short = scene(tmp_path, GOOD), ["time.duration=0.05"]
    whole = run_simulate(path, short, tmp_path / "whole", threads=1)
    with pytest.raises(Stopped):
        run_simulate(path, short, tmp_path / "out", threads=1, reporter=Listener(stop_after=2))
    (run,) = (tmp_path / "out" / "finger").iterdir()
    record(tmp_path, 0.41)
    with pytest.raises(UsageError, match=r"rest\.txt has changed since the run began; run the scene again"):
        run_resume(run, (), threads=1)
    assert run_simulate(path, short, tmp_path / "out", threads=1) != run
    record(tmp_path, 0.4)
    assert_same(run_resume(run, (), threads=1), whole)
    assert np.loadtxt(tmp_path / "rest.txt").tolist() == [0.4, 0.5]

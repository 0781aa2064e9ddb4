"""Runs of a body that is read from a file: the file is part of the run's name, and may not change under it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_beam import Listener, assert_same, changed

from cqrun.build.particles import sample
from cqrun.errors import SceneError, Stopped, UsageError
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.validate import validate
from cqrun.running.runs import run_scene
from cqrun.scene.load import load_scene
from cqrun.store.run import read_record

BOX = "shape: {box: {corner: [0.02, 0.06], size: [0.1, 0.01]}}"
COLOURS = 'colours: {dark: "#000000", blue: "#0000ff"}'
IMAGE = f"shape: {{image: {{file: beam.png, corner: [0.02, 0.06], width: 0.1, {COLOURS}}}}}"


def draw(folder: Path, split: int) -> None:
    """Draw the beam in ten pixels, dark on the left and blue from one of them on."""
    pixels = np.zeros((1, 10, 3), np.uint8)
    pixels[0, split:, 2] = 255
    Image.fromarray(pixels).save(folder / "beam.png")


@pytest.fixture
def drawn(beam: Path) -> Path:
    """Return the small beam, drawn."""
    draw(beam.parent, 4)
    return changed(beam, BOX, IMAGE)


def simulate(scene: Path, out: Path, *overrides: str, reporter: Listener | None = None) -> Path:
    return run_simulate(scene, overrides, out, threads=1, reporter=reporter)


def test_colours_are_groups_of_the_same_particles_as_a_box(beam, drawn):
    particles = sample(load_scene(drawn))
    assert {name: len(held) for name, held in particles.groups("beam").items()} == {"dark": 16, "blue": 24, "root": 20}
    assert len(particles.inside("beam", "blue")) == 24
    box = sample(load_scene(drawn, ["bodies.beam.shape={box: {corner: [0.02, 0.06], size: [0.1, 0.01]}}"]))
    assert particles.x == pytest.approx(box.x)


def test_a_run_is_named_after_the_file_and_what_it_holds(drawn, tmp_path):
    first = simulate(drawn, tmp_path / "out", "time.duration=0.02")
    assert read_record(first)["files"].keys() == {"beam.png"}
    draw(drawn.parent, 5)
    second = simulate(drawn, tmp_path / "out", "time.duration=0.02")
    assert first != second
    draw(drawn.parent, 4)
    assert simulate(drawn, tmp_path / "out", "time.duration=0.02") == first


def test_a_stopped_run_goes_on_from_the_file_where_it_was(drawn, tmp_path, monkeypatch):
    short = "time.duration=0.04"
    whole = simulate(drawn, tmp_path / "whole", short)
    with pytest.raises(Stopped):
        simulate(drawn, tmp_path / "out", short, reporter=Listener(stop_after=2))
    (run,) = (tmp_path / "out" / "beam").iterdir()
    monkeypatch.chdir("/")
    draw(drawn.parent, 5)
    with pytest.raises(UsageError, match=r"beam\.png has changed since the run began; run the scene again"):
        run_resume(run, (), threads=1)
    draw(drawn.parent, 4)
    assert_same(run_resume(run, (), threads=1), whole)


def test_a_file_that_cannot_be_used_is_told_with_its_place(drawn):
    (drawn.parent / "beam.png").unlink()
    with pytest.raises(SceneError, match=r"beam.yaml:7:27: bodies.beam.shape.image.file: .*beam.png: cannot be read"):
        list(validate(drawn))
    Image.new("RGB", (10, 1), "white").save(drawn.parent / "beam.png")
    with pytest.raises(SceneError, match=r"bodies\.beam\.shape\.image\.file: .*: an image of one colour"):
        list(validate(drawn))


def test_files_of_observers_and_objectives_name_the_run_too():
    """What `pca` was fitted to, what a body follows: with another file there it is another run."""
    finger = Path(__file__).parents[2] / "scenes/control/finger.yaml"
    parts = [
        "objective.tip={track: {body: finger, marker: {file: wave.csv, marker: tip}}}",
        "observers.bent={pca: {body: finger, components: 2, file: bent.npz}}",
        "observers.blind={pca: {body: finger, components: 2}}",
        "data={recordings: {seen: {file: seen.csv}}}",
    ]
    scene = load_scene(finger, [*parts, "goals={}", "observers.goal={clock: {}}"])
    assert run_scene("finger", scene, job="control", with_data=False).files == {
        name: finger.parent / name for name in ("wave.csv", "bent.npz")
    }

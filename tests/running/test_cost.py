"""The estimated time of a run: its parts, and the pictures of its film."""

from __future__ import annotations

import re

import pytest
from small_finger import written
from tiny_beam import BEAM

from cqrun.build.model import build
from cqrun.figures.run_data import read_run
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.validate import validate
from cqrun.report.film import make_film
from cqrun.running.cost import DOT, FEW_FRAMES, FILM, MOST_FRAMES, PICTURES, START, film_step, picture_seconds
from cqrun.running.trajectories import count_frames
from cqrun.scene.load import load_scene

WHOLE = re.compile(r"about ([\d.]+) s, with ([\d.]+) s to start and ([\d.]+) s for pictures and report")


@pytest.fixture
def beam(tmp_path):
    path = tmp_path / "beam.yaml"
    path.write_text(BEAM.replace("duration: 0.1", "duration: 1.2"))
    return path


def test_the_estimate_counts_the_frames_and_the_pictures_that_a_run_makes(beam, tmp_path):
    built = build(load_scene(beam))
    run = read_run(run_simulate(beam, [], tmp_path / "out", threads=1))
    with run.frames() as frames:
        assert count_frames(built) == len(frames) == 121
    film = make_film(run, tmp_path)
    assert film is not None
    assert film.frames == 41
    assert picture_seconds(2, 80, 121) == pytest.approx(PICTURES + 41 * (FILM[2] + 80 * DOT))


@pytest.mark.parametrize(("frames", "particles"), [(2, 1), (48, 10), (49, 10), (500, 10), (500, 10**6), (500, 60_000)])
def test_a_film_has_no_more_pictures_than_it_may(frames, particles):
    drawn = len(range(0, frames, film_step(frames, particles)))
    assert drawn <= MOST_FRAMES + 1
    assert drawn <= max(FEW_FRAMES, 1_500_000 // particles) + 1
    assert drawn >= min(frames, FEW_FRAMES) // 2


def test_films_in_3d_cost_nothing_if_they_cannot_be_drawn(monkeypatch):
    monkeypatch.setattr("cqrun.running.cost.find_spec", lambda name: None)
    assert picture_seconds(3, 80, 121) == PICTURES
    monkeypatch.setattr("cqrun.running.cost.find_spec", lambda name: name)
    assert picture_seconds(3, 80, 121) == pytest.approx(PICTURES + 41 * FILM[3])


def test_validate_reports_the_whole_time_of_a_simulation(beam):
    whole, start, pictures = map(float, WHOLE.search("\n".join(validate(beam))).groups())
    assert start == START
    assert pictures == pytest.approx(PICTURES + 41 * FILM[2], rel=0.05)
    assert whole == pytest.approx(start + pictures + 120 * 2e-3, rel=0.05)


def test_validate_reports_the_whole_time_of_a_training(tmp_path):
    text = "\n".join(validate(written(tmp_path)))
    once = re.search(r"an iteration of adam: .*, ([\d.]+) s", text)
    assert once is not None
    whole, start, pictures = map(float, WHOLE.search(text).groups())
    count = int(re.search(r"a whole run of (\d+) iterations", text)[1])
    assert whole >= 0.95 * (start + pictures + count * float(once[1]))

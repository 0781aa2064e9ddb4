"""A command that is repeated: a finished run is shown at once, and drawn only where something is missing."""

from __future__ import annotations

import os

import pytest
from tiny_beam import BEAM

from cqrun.store.run import read_record

pytestmark = pytest.mark.usefixtures("pictures")


@pytest.fixture
def scene(tmp_path):
    """Return the scene of the tiny beam, in a folder of its own."""
    path = tmp_path / "beam.yaml"
    path.write_text(BEAM)
    return path


def run_of(scene):
    """Return the only run of a scene."""
    (run,) = (scene.parent / "results" / "beam").glob("*/")
    return run


def files(run):
    """Return when each file of a run was written, by name; a repeated command opens its lock and no other file."""
    return {str(f.relative_to(run)): f.stat().st_mtime_ns for f in run.rglob("*") if f.is_file() and f.name != "lock"}


def test_a_finished_run_is_shown_without_drawing(cqrun, scene, monkeypatch):
    code, out, err = cqrun("simulate", scene)
    assert code == 0, err
    run = run_of(scene)
    before = files(run)
    assert {"figures/bodies.png", "figures/reactions.png", "report.html"} <= set(before)
    monkeypatch.setattr("cqrun.figures.draw.draw_run", None)
    code, again, err = cqrun("simulate", scene)
    assert (code, again) == (0, out)
    assert files(run) == before
    told = f"pictures and report are there; `cqrun plot {run}` and `cqrun report {run}` make them again\n"
    assert err.endswith(f"finished already (done); --fresh starts over\n{told}")
    code, again, err = cqrun("simulate", scene, "--quiet")
    assert (code, again) == (0, out)
    assert "make them again" not in err
    monkeypatch.setenv("CQRUN_PICTURES", "0")
    code, again, err = cqrun("resume", run)
    assert (code, again) == (0, out)
    assert err.endswith(f"the report is there; `cqrun report {run}` writes it again\n")
    assert files(run) == before


def test_what_is_missing_is_made_again(cqrun, scene, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setenv("CQRUN_PICTURES", "0")
        assert cqrun("simulate", scene)[0] == 0
    run = run_of(scene)
    assert "figures/bodies.png" not in files(run)
    plain = (run / "report.html").stat().st_size
    assert cqrun("simulate", scene)[0] == 0  # it was made without pictures
    whole = files(run)
    assert "figures/bodies.png" in whole
    assert (run / "report.html").stat().st_size > plain
    for name in ("figures/reactions.png", "report.html"):
        (run / name).unlink()
        assert cqrun("simulate", scene)[0] == 0
        assert set(files(run)) == set(whole)
    assert cqrun("plot", run)[0] == 0  # the report has the pictures of before
    drawn = files(run)
    assert cqrun("simulate", scene)[0] == 0
    assert files(run)["report.html"] > drawn["report.html"]


def test_pictures_of_an_earlier_result_are_drawn_again(cqrun, scene):
    """As those of a run that was killed while it drew its last result."""
    assert cqrun("rest", scene)[0] == 0
    run = run_of(scene)
    before = files(run)
    later = before["report.html"] + 1
    os.utime(run / "result.json", ns=(later, later))
    assert cqrun("rest", scene)[0] == 0
    now = files(run)
    assert all(now[name] > before[name] for name in before if name.startswith("figures/") or name == "report.html")


def test_fresh_makes_it_anew(cqrun, scene):
    assert cqrun("simulate", scene)[0] == 0
    began = read_record(run_of(scene))["began"], files(run_of(scene))["result.json"]
    assert cqrun("simulate", scene, "--fresh")[0] == 0
    now = read_record(run_of(scene))["began"], files(run_of(scene))["result.json"]
    assert now > began


def test_finished_grids_of_a_study_are_not_drawn_again(cqrun, scene, monkeypatch):
    words = ("rest", scene, "--resolution", "0.02,0.013")
    code, out, err = cqrun(*words)
    assert code == 0, err
    runs = [run for run in (scene.parent / "results" / "beam").glob("*/") if run.is_dir()]
    before = [files(run) for run in runs]
    assert all("report.html" in each for each in before)
    monkeypatch.setattr("cqrun.figures.draw.draw_run", None)
    code, again, err = cqrun(*words)
    assert (code, again) == (0, out), err
    assert [files(run) for run in runs] == before

"""Pictures are written to the run's figures/, or an error says why not; `cqrun plot` draws and compares."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from made_runs import YOUNG, history, made_twin, plane_scene, swing, write_history, write_run, write_trajectory

from cqrun.cli import app as cli
from cqrun.errors import UsageError
from cqrun.figures.draw import draw_run, draw_several
from cqrun.figures.reactions import draw_reactions
from cqrun.figures.run_data import read_run
from cqrun.figures.style import styled
from cqrun.jobs.table import job_of
from cqrun.running.reaction_table import write_reaction_table
from cqrun.store.reactions import Reactions

ALL = ["convergence", "tracks_synthetic", "bodies", "overview"]
MAGIC = {"png": b"\x89PNG\r\n", "pdf": b"%PDF-"}


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return made_twin(tmp_path_factory.mktemp("runs"), np.random.default_rng(3))


@pytest.fixture
def copy(twin, tmp_path):
    return shutil.copytree(twin, tmp_path / "twin" / "0123456789ab")


@pytest.fixture
def started(tmp_path):
    """Return a run after its first evaluation."""
    path = f"bodies.a.{YOUNG}"
    run = write_run(tmp_path, plane_scene({path: {"bounds": [1e5, 5e5]}}), status="running")
    write_history(run, history(1, {path: np.array([2e5])}))
    return run


def set_record(run, **facts):
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(record | facts))


def command(capsys, *words):
    """Return exit code, standard output and standard error of `cqrun words...`."""
    with pytest.raises(SystemExit) as ended:
        cli.main([str(word) for word in words])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def test_a_finished_run_has_all_its_pictures(copy):
    paths = draw_run(copy)
    assert paths == [copy / "figures" / f"{name}.png" for name in ALL]
    assert all(path.read_bytes().startswith(MAGIC["png"]) for path in paths)
    assert sorted(path.name for path in (copy / "figures").iterdir()) == sorted(path.name for path in paths)


def test_plot_draws_a_run_again_as_png_and_pdf(capsys, started):
    code, out, err = command(capsys, "plot", started)
    assert (code, err) == (0, "")
    paths = [started / "figures" / f"convergence.{kind}" for kind in MAGIC]
    assert out.splitlines() == [str(path) for path in paths]
    assert all(path.read_bytes().startswith(MAGIC[path.suffix[1:]]) for path in paths)


def test_plot_compares_several_runs(capsys, twin, tmp_path, rng):
    other = made_twin(tmp_path, rng, name="other/ba9876543210")
    code, out, _ = command(capsys, "plot", twin, other, "--out", tmp_path / "figures")
    assert code == 0
    paths = [tmp_path / "figures" / f"compare_twin_other.{kind}" for kind in MAGIC]
    assert out.splitlines() == [str(path) for path in paths]
    assert all(path.is_file() for path in paths)
    assert not (other / "figures").exists()


def test_the_loss_can_be_selected_by_name(capsys, twin, tmp_path):
    code, out, _ = command(capsys, "plot", twin, "--show", "loss", "--out", tmp_path)
    assert (code, out.splitlines()) == (0, [str(tmp_path / f"compare_twin.{kind}") for kind in MAGIC])


def test_a_selected_quantity_of_one_run_is_drawn_in_its_figures(capsys, tmp_path, rng):
    twin = made_twin(tmp_path, rng, name="twin/aaaaaaaaaaaa")
    code, out, _ = command(capsys, "plot", twin, "--show", "loss")
    assert (code, out.splitlines()) == (0, [str(twin / "figures" / f"compare_twin.{kind}") for kind in MAGIC])


def test_a_picture_of_other_runs_is_not_overwritten(twin, tmp_path, rng):
    """Scenes can have the same name; the same runs in any order are one picture."""
    variant, copy = (made_twin(tmp_path / place, rng, name=f"twin/{k * 12}") for place, k in (("a", "a"), ("b", "a")))
    first = draw_several([twin, variant], tmp_path, ("png", "pdf"))
    other = draw_several([variant], tmp_path, ("png", "pdf"))
    assert [path.name for path in first] == ["compare_twin.png", "compare_twin.pdf"]
    assert not {*first} & {*other}
    assert all(path.name.startswith("compare_twin_") for path in other)
    assert draw_several([copy, twin], tmp_path, ("png", "pdf")) == first
    assert draw_several([copy], tmp_path, ("png",)) == other[:1]


def test_files_among_the_runs_are_skipped(capsys, copy, tmp_path):
    """A shell expands results/SCENE/* to runs and to files that summarise them."""
    summary = tmp_path / "summary-3.csv"
    summary.write_text("")
    code, out, err = command(capsys, "plot", copy, summary)
    assert (code, err.splitlines()[0]) == (0, f"skipped: {summary} is a file and not a run")
    assert str(copy) in out
    code, _, err = command(capsys, "plot", summary)
    assert code == 2


def test_an_unfinished_run_is_drawn_as_far_as_possible(started):
    assert [p.name for p in draw_run(started)] == ["convergence.png"]


def test_a_simulation_shows_its_bodies(tmp_path, rng):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="done")
    time, _, x = swing(rng, 5, 2)
    write_trajectory(run, x, time)
    assert [p.name for p in draw_run(run)] == ["bodies.png"]


@pytest.mark.parametrize(("push", "drawn"), [(3.0, ["bodies.png", "reactions.png"]), (0.0, ["bodies.png"])])
def test_a_simulation_shows_the_reactions_of_boundaries_that_act(tmp_path, rng, push, drawn):
    scene = plane_scene({})
    scene["boundaries"] = {"clamp": {"sticky": {"face": "x_min"}}, "floor": {"sticky": {"face": "y_min"}}}
    run = write_run(tmp_path, scene, job="simulate", status="done")
    time, _, x = swing(rng, 5, 2)
    write_trajectory(run, x, time)
    force = np.zeros((4, 2))
    force[2, 1] = push
    nothing = np.zeros((4, 2))
    moments = {"clamp": np.zeros((4, 1)), "floor": np.zeros((4, 1))}
    write_reaction_table(
        run / "reactions.csv", Reactions(0.01 * np.arange(1, 5), {"clamp": force, "floor": nothing}, moments)
    )
    assert [p.name for p in draw_run(run)] == drawn
    if push:
        with styled():
            axes = draw_reactions(read_run(run)).axes
        assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["clamp, x", "clamp, y"]
        assert axes[0].lines[1].get_ydata().max() == push
        assert axes[0].get_ylabel() == "force on the bodies [N/m]"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("history.csv", "there is no history.csv, so there is no convergence to draw"),
        ("result.json", "there is no result.json, although the run has finished"),
        ("tracks.csv", "there is no tracks.csv, although the run has finished"),
        ("trajectory.h5", "there is no trajectory.h5, although the run has finished"),
        ("run.json", "no run (it has no run.json)"),
        ("scene.yaml", "there is no scene.yaml"),
    ],
)
def test_a_missing_file_is_reported(capsys, copy, name, message):
    (copy / name).unlink()
    code, out, err = command(capsys, "plot", copy)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: {copy}: {message}")
    assert not (copy / "figures").exists()


def test_a_damaged_trajectory_is_reported(copy):
    (copy / "trajectory.h5").write_text("no HDF5")
    with pytest.raises(UsageError, match=r"trajectory\.h5: not a cqrun trajectory"):
        draw_run(copy)


def test_a_run_without_iterations_cannot_be_drawn(tmp_path):
    run = write_run(tmp_path, plane_scene({}), status="running")
    (run / "history.csv").write_text("iteration,loss,seconds\n")
    with pytest.raises(UsageError, match="nothing to draw before the first iteration"):
        draw_run(run)


def test_a_simulation_without_frames_cannot_be_drawn(tmp_path):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="running")
    with pytest.raises(UsageError, match="nothing to draw before the first frame"):
        draw_run(run)


def test_a_job_without_pictures_cannot_be_drawn(copy):
    assert job_of(copy).pictures
    set_record(copy, job="gradcheck")
    assert not job_of(copy).pictures
    message = "'gradcheck' has no pictures; runs of sysid, control, codesign, simulate and rest have them"
    with pytest.raises(UsageError, match=message):
        draw_run(copy)


def test_a_failed_run_still_shows_its_convergence(copy):
    set_record(copy, status="failed")
    for name in ("tracks.csv", "trajectory.h5"):
        (copy / name).unlink()
    assert [path.name for path in draw_run(copy)] == ["convergence.png"]


def test_a_folder_that_cannot_be_made_is_reported(copy):
    (copy / "figures").write_text("in the way")
    with pytest.raises(UsageError, match="figures: is not an ordinary folder"):
        draw_run(copy)


def test_equal_runs_make_equal_files_with_any_user_settings_and_without_pyplot(twin, tmp_path):
    code = (
        "import sys, pathlib, matplotlib\n"
        "matplotlib.rcParams['axes.facecolor'] = 'black'\n"
        "from cqrun.figures.draw import draw_several\n"
        "draw_several([pathlib.Path(sys.argv[1])], pathlib.Path(sys.argv[2]), ('png', 'pdf'))\n"
        "print('matplotlib.pyplot' in sys.modules, matplotlib.rcParams['axes.facecolor'])\n"
    )
    words = [sys.executable, "-W", "error", "-c", code, str(twin), str(tmp_path / "theirs")]
    bare = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MPLBACKEND")}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=bare)
    assert done.stdout.split() == ["False", "black"]
    ours = draw_several([twin], tmp_path / "ours", ("png", "pdf"))
    assert [path.read_bytes() for path in ours] == [(tmp_path / "theirs" / p.name).read_bytes() for p in ours]

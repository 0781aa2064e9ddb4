"""`cqrun render`, `cqrun plot --show` and `cqrun export`: combinations of options, and error messages."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_beam import BEAM

from cqrun.build.particles import sample
from cqrun.cli.render import _kinds
from cqrun.errors import UsageError
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.store.atomic import write_json, write_text
from cqrun.store.trajectory import TrajectoryWriter


@pytest.fixture
def beam_run(tmp_path: Path) -> Path:
    """Return a run of the small beam with three frames."""
    run = tmp_path / "beam" / "0123456789ab"
    run.mkdir(parents=True)
    scene = load_scene(BEAM)
    write_text(run / "scene.yaml", dump(resolve(scene)))
    write_json(run / "run.json", {"status": "done", "seconds": 1.0, "job": "simulate", "base": str(tmp_path)})
    x = sample(scene).x
    with TrajectoryWriter(run / "trajectory.h5", 3, {"beam": slice(0, len(x))}, 2, {"v": (2,)}, {}) as writer:
        for k in range(3):
            writer.write(k, 0.05 * k, x=x + 1e-3 * k, v=np.ones_like(x))
    return run


@pytest.mark.parametrize(
    ("asked", "output", "kind"),
    [
        ([], None, "gif"),
        ([], "a.mp4", "mp4"),
        ([], "a.PNG", "png"),
        (["onion"], "a.png", "onion"),
        (["stills"], None, "stills"),
    ],
)
def test_the_option_or_the_suffix_selects_what_is_drawn(asked, output, kind):
    assert _kinds(asked, Path(output) if output else None) == [kind]


def test_several_options_draw_several_files():
    assert _kinds(["gif", "mp4", "onion"], None) == ["gif", "mp4", "onion"]


@pytest.mark.parametrize(
    ("asked", "output", "message"),
    [
        (["gif", "mp4"], "a.gif", r"-o a\.gif: one file cannot be --gif and --mp4: leave out -o, or give one of them"),
        (["mp4"], "a.gif", r"-o a\.gif: must end in \.mp4, as --mp4 makes it"),
        ([], "a.avi", r"-o a\.avi: must end in \.gif, .*or in \.gif, \.mp4 or \.png"),
    ],
)
def test_contradictory_options_are_refused(asked, output, message):
    with pytest.raises(UsageError, match=message):
        _kinds(asked, Path(output) if output else None)


def test_the_command_prints_the_files(cqrun, beam_run):
    code, out, err = cqrun("render", beam_run, "--stills", 2, "--color", "velocity", "--trail", "root", "-q")
    assert (code, err) == (0, "")
    paths = [beam_run / "figures" / f"still_velocity_{k}.png" for k in (1, 2)]
    assert out.splitlines() == [str(path) for path in paths]
    assert all(path.is_file() for path in paths)


def test_two_options_write_two_files(cqrun, beam_run):
    code, out, err = cqrun("render", beam_run, "--png", "--stills", 2, "--onion", 3, "--color", "velocity", "-q")
    assert (code, err) == (0, "")
    names = ["last_velocity.png", "still_velocity_1.png", "still_velocity_2.png", "onion_velocity.png"]
    assert out.splitlines() == [str(beam_run / "figures" / name) for name in names]
    assert all((beam_run / "figures" / name).is_file() for name in names)


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="the extra video is not installed")
def test_a_gif_and_an_mp4_at_once(cqrun, beam_run):
    code, out, _ = cqrun("render", beam_run, "--gif", "--mp4", "--color", "velocity", "-q")
    assert code == 0
    assert [Path(line).name for line in out.splitlines()] == ["motion_velocity.gif", "motion_velocity.mp4"]


def test_nothing_is_drawn_if_a_missing_extra_is_needed_for_one_of_several_files(cqrun, beam_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    code, _, err = cqrun("render", beam_run, "--gif", "--mp4")
    assert code == 2
    assert "--mp4 needs imageio-ffmpeg" in err
    assert not (beam_run / "figures").exists()


def test_a_warning_gives_the_actual_rate_of_a_gif(cqrun, beam_run, tmp_path):
    code, out, err = cqrun("render", beam_run, "--fps", 30, "-o", tmp_path / "a.gif")
    assert (code, out) == (0, f"{tmp_path / 'a.gif'}\n")
    assert "warning: pictures of a GIF last whole hundredths of a second: 33.3 per second instead of 30" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--color", "activation"], "--color activation: the scene of this run has no actuators"),
        (["--view", "top"], "--view top: the world of this run has two dimensions, so it has only one view"),
        (["--trail", "tip"], "--trail tip: no body or group has this name; there are: beam, beam.root, none"),
        (["--stills", 9], "--stills 9: the trajectory has only 3 frames"),
    ],
)
def test_pictures_that_cannot_be_drawn_are_refused(cqrun, beam_run, words, message):
    code, out, err = cqrun("render", beam_run, *words, "-q")
    assert (code, out) == (2, "")
    assert f"error: {message}" in err
    assert not list((beam_run).glob("figures/*"))


@pytest.mark.parametrize("words", [["--color", "heat"], ["--stills", 0], ["--onion", 1], ["--fps", 0], ["--every", 0]])
def test_values_out_of_range_are_usage_errors(cqrun, beam_run, words):
    code, _, err = cqrun("render", beam_run, *words)
    assert code == 2
    assert "Usage: cqrun render" in err


def test_the_error_names_a_missing_extra(cqrun, beam_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    code, _, err = cqrun("render", beam_run, "--mp4")
    assert code == 2
    assert "error: --mp4 needs imageio-ffmpeg, which is not installed: pip install 'cqrun[video]'" in err


def test_a_full_disk_and_a_read_only_disk(beam_run, tmp_path):
    disk, unshare = tmp_path / "disk", shutil.which("unshare")
    disk.mkdir()
    spaces = ["--mount"] if os.geteuid() == 0 else ["--user", "--map-root-user", "--mount"]
    mount = f"mount -t tmpfs -o size=8k tmpfs {disk}"
    if unshare is None or subprocess.run([unshare, *spaces, "sh", "-c", mount], capture_output=True).returncode != 0:
        pytest.skip("no small disk can be mounted here")
    kinds = ["gif", "png", *(["mp4"] if importlib.util.find_spec("imageio_ffmpeg") else [])]
    program = (
        "import subprocess, sys\nfrom cqrun.cli.app import main\n"
        "for turn in range(2):\n"
        f"    for kind in {kinds}:\n"
        "        try: main(['render', sys.argv[1], '-q', '-o', f'{sys.argv[2]}/a.{kind}'])\n"
        "        except SystemExit as end: print(kind, end.code)\n"
        "    subprocess.run(['mount', '-o', 'remount,ro', sys.argv[2]], check=True)\n"
    )
    words = f'{mount} && {sys.executable} -c "$PROGRAM" {beam_run} {disk}; ls -A {disk}'
    environment = {**os.environ, "PROGRAM": program}
    done = subprocess.run([unshare, *spaces, "sh", "-c", words], capture_output=True, text=True, env=environment)
    assert done.stdout.splitlines() == [f"{kind} {code}" for code in (1, 2) for kind in kinds]
    assert done.stderr.count("the disk is full") == len(kinds), done.stderr
    refused = "cannot be written (Read-only file system); choose another place with --out"
    assert done.stderr.count(refused) == len(kinds), done.stderr


def test_an_unknown_term_is_refused(cqrun, beam_run):
    write_text(beam_run / "history.csv", "iteration,loss,seconds\n0,1.0,0.5\n")
    code, _, err = cqrun("plot", beam_run, "--show", "far")
    assert code == 2
    assert f"error: {beam_run}: it has no term or constraint 'far'" in err


@pytest.mark.parametrize("words", [[], ["--design"]])
def test_export_without_an_option_exports_the_design(cqrun, beam_run, monkeypatch, words):
    asked = []
    monkeypatch.setattr("cqrun.jobs.export.export_design", lambda run, out, _: asked.append((run, out)) or [out])
    assert cqrun("export", beam_run, *words, "-q") == (0, f"{beam_run / 'design'}\n", "")
    assert asked == [(beam_run, beam_run / "design")]


def test_export_of_a_run_without_a_design_says_where_its_motion_is(cqrun, beam_run):
    result = {
        "job": "simulate",
        "status": "done",
        "message": "",
        "time": 0.1,
        "bodies": {},
        "fracture": {},
        "findings": [],
    }
    write_json(beam_run / "result.json", result)
    code, _, err = cqrun("export", beam_run)
    assert code == 2
    motion = beam_run / "trajectory.h5"
    assert f"has no `unknowns`: nothing was designed; its motion is in {motion}, which ParaView and h5py read" in err

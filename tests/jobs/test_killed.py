"""SIGKILL at random moments, resumed each time: the same result as never stopped."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hangup import NOT_UNDER_NOHUP
from small_beam import BEAM, FIT, assert_same, changed, record, recorded
from small_finger import DESIGN, FINGER, written

from cqrun.build.model import build
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene
from cqrun.store.run import read_record
from cqrun.store.trajectory import read_trajectory

ROOT = Path(__file__).parents[2]
OPTIMIZERS = {
    "least_squares": "optimizer={least_squares: {max_iterations: 12}}",
    "lbfgs": "optimizer={lbfgs: {max_iterations: 15}}",
    "adam": "optimizer={adam: {max_iterations: 30, batch_size: 2}}",
    "sgd": "optimizer={sgd: {max_iterations: 30, momentum: 0.5, clip: 1, mask: 0.2, batch_size: 2}}",
    "cma_es": "optimizer={cma_es: {max_iterations: 20, population: 6}}",
}
LEARNERS = {
    "lbfgs": "optimizer={lbfgs: {max_iterations: 25}}",
    "adam": "optimizer={adam: {learning_rate: 0.1, max_iterations: 40, batch_size: 1}}",
    "sgd": "optimizer={sgd: {learning_rate: 1, max_iterations: 40, momentum: 0.5, clip_entries: 1, mask: 0.2}}",
    "cma_es": "optimizer={cma_es: {max_iterations: 20, population: 6}}",
}
"""For control, where sgd draws fresh goals at every iteration."""

DESIGNERS = {
    "slsqp": "optimizer={slsqp: {max_iterations: 60}}",
    "sqp": "optimizer={sqp: {max_iterations: 60}}",
    "trust_constr": "optimizer={trust_constr: {max_iterations: 30}}",
    "augmented_lagrangian": "optimizer={augmented_lagrangian: {max_iterations: 60, learning_rate: 0.05}}",
    "nlopt_slsqp": "optimizer={nlopt: {algorithm: slsqp, max_iterations: 60}}",
    "nlopt_mma": "optimizer={nlopt: {algorithm: mma, max_iterations: 60}}",
    "nlopt_auglag": "optimizer={nlopt: {algorithm: auglag, max_iterations: 60}}",
}

MANY = 30
"""Kills of each method in the long tests: 500 in all, with those of simulations and checks."""

PATIENCE = 120.0
"""Longest that one process may take [s]."""


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    """Compile the kernels, so that kills meet the work and not the compiler."""
    compile_kernels([build(load_scene(BEAM)), build(load_scene(FINGER))], Silent(), adjoint=True)


def start(*words: str | Path) -> subprocess.Popen[str]:
    """Start `cqrun words...` on this very tree."""
    command = [sys.executable, "-m", "cqrun", *map(str, words), "--threads", "1", "--quiet"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, **pipes)


def finish(process: subprocess.Popen[str]) -> None:
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, out + err


def kill_after(process: subprocess.Popen[str], begun: Path, delay: float) -> bool:
    """Kill a process some time after it took hold of its run; return whether it was still alive.

    `begun` is the run's log, or the folder of runs while there is none: it changes as soon as work begins.
    """
    deadline = time.monotonic() + PATIENCE
    before = _stamp(begun)
    while _stamp(begun) == before and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    try:
        process.wait(timeout=delay)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return True
    finish(process)
    return False


def _stamp(folder: Path) -> tuple[int, ...]:
    """Return when each run.json below a folder was written last; `--fresh` may remove one as we look."""
    stamps = []
    for path in sorted(folder.glob("*/*/run.json")):
        with contextlib.suppress(FileNotFoundError):
            stamps.append(path.stat().st_mtime_ns)
    return tuple(stamps)


def killed_and_resumed(
    scene: Path, folder: Path, override: str, kills: int, rng: np.random.Generator, job: str = "sysid"
) -> None:
    begin = time.monotonic()
    finish(start(job, scene, "-o", override, "--out", folder / "whole"))
    (whole,) = (folder / "whole").glob("*/*")
    work = read_record(whole)["seconds"]  # of the job itself, without the start of Python
    out, done, alive = folder / "killed", 0, 0
    while alive < kills:  # those that met a process that still ran
        assert done < 3 * kills, f"only {alive} of {done} kills met a process that still ran"
        (run,) = [record.parent for record in out.glob("*/*/run.json")] or [None]  # none while `--fresh` deletes it
        finished = run is not None and read_record(run)["status"] == read_record(whole)["status"]
        if finished:  # before all kills were dealt: begin again, so that every kill hits something
            words: tuple[str | Path, ...] = (job, scene, "-o", override, "--out", out, "--fresh")
        elif run is None or done % 2:
            words = (job, scene, "-o", override, "--out", out)
        else:
            words = ("resume", run)
        alive += kill_after(start(*words), out, float(rng.uniform(0.0, 0.9 * work)))
        done += 1
    (run,) = out.glob("*/*")
    finish(start("resume", run))
    assert_same(run, whole)
    assert time.monotonic() - begin < PATIENCE * (done + 2)


@pytest.fixture
def recordings(fit, tmp_path):
    """Return a scene of three recordings, for mini-batches."""
    files = record(fit, tmp_path / "data", copies=3)
    return recorded(fit, {file.stem: file for file in files})


def test_killed_three_times(fit, tmp_path, rng):
    killed_and_resumed(fit, tmp_path, OPTIMIZERS["least_squares"], 3, rng)


@pytest.mark.slow
def test_learning_killed_three_times(tmp_path, rng):
    killed_and_resumed(written(tmp_path), tmp_path, LEARNERS["adam"], 3, rng, "control")


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNERS)
def test_learning_killed_many_times(tmp_path, rng, name):
    scene = written(tmp_path)
    if name == "sgd":
        changed(scene, "unseen: 1", "unseen: 1, fresh: true")
    killed_and_resumed(scene, tmp_path, LEARNERS[name], MANY, rng, "control")


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNERS)
def test_a_design_killed_many_times(tmp_path, rng, name):
    if name.startswith("nlopt"):
        pytest.importorskip("nlopt", reason="the extra nlopt is absent")
    scene = written(tmp_path, DESIGN)
    changed(scene, "at_most: 0.018, scale: 0.01", "at_most: 0.03, scale: 0.01")
    killed_and_resumed(scene, tmp_path, DESIGNERS[name], MANY, rng, "codesign")


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_a_fit_killed_many_times(fit, recordings, tmp_path, rng, name):
    scene = recordings if "batch_size" in OPTIMIZERS[name] else fit
    killed_and_resumed(scene, tmp_path, OPTIMIZERS[name], MANY, rng)


@pytest.mark.slow
@pytest.mark.parametrize("job", ["simulate", "gradcheck"])
def test_a_job_without_an_optimizer_killed_ten_times(fit, tmp_path, rng, job):
    killed_and_resumed(fit, tmp_path, "time.substeps=1500", 10, rng, job)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Return the words of an identification that takes a while, and its finished run."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "fit.yaml").write_text(BEAM + FIT)
    words = ("sysid", folder / "fit.yaml", "-o", "optimizer={adam: {max_iterations: 80}}")
    finish(start(*words, "--out", folder))
    return words, next(folder.glob("*/*/run.json")).parent


@pytest.mark.parametrize(
    ("number", "code", "name"),
    [
        (signal.SIGINT, 130, "SIGINT (Ctrl-C)"),
        (signal.SIGTERM, 75, "SIGTERM"),
        pytest.param(signal.SIGHUP, 75, "SIGHUP (the terminal is gone)", marks=NOT_UNDER_NOHUP),
    ],
)
def test_a_signal_finishes_the_iteration_and_leaves_a_run_that_goes_on(undisturbed, tmp_path, number, code, name):
    words, whole = undisturbed
    process = start(*words, "--out", tmp_path / "stopped")
    deadline = time.monotonic() + PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        if any(len(file.read_text().splitlines()) > 3 for file in tmp_path.glob("stopped/*/*/history.csv")):
            break
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out) == (code, ""), err
    assert "warning: stopping after the rollout at hand (once more: abort now)" in err
    (run,) = (tmp_path / "stopped").glob("*/*")
    assert err.splitlines()[-1].startswith(f"error: {name}: asked to stop after iteration ")
    assert err.splitlines()[-1].endswith(f"; `cqrun resume {run}` continues")
    record = read_record(run)
    assert record["status"] == "stopped"
    assert record["reason"].startswith(f"{name}: asked to stop after iteration ")
    finish(start("resume", run))
    assert_same(run, whole)


IN_A_TERMINAL = """
import os, pathlib, pty, select, sys, time
pid, terminal = pty.fork()
if pid == 0:
    os.execv(sys.executable, [sys.executable, "-m", "cqrun", *sys.argv[2:]])
began = time.monotonic()
while not list(pathlib.Path(sys.argv[1]).glob("*/*/trajectory.h5.part")) and time.monotonic() - began < 100:
    if select.select([terminal], [], [], 0.05)[0]:
        os.read(terminal, 4096)
os.close(terminal)
print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""


@NOT_UNDER_NOHUP
def test_a_terminal_that_is_closed_stops_a_run_that_goes_on(beam, tmp_path):
    """Nothing can be printed any more, and this is no error."""
    changed(beam, "substeps: 24", "substeps: 40000")
    out = tmp_path / "out"
    words = [sys.executable, "-c", IN_A_TERMINAL, out, "simulate", beam, "--threads", "1", "--out", out]
    code = subprocess.run(words, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE,
                          text=True, timeout=PATIENCE, check=True).stdout  # fmt: skip
    assert code == "75\n"
    (run,) = out.glob("*/*")
    record = read_record(run)
    assert record["status"] == "stopped"
    assert record["reason"].startswith("SIGHUP (the terminal is gone): stopped at t = ")


def test_a_killed_simulation_keeps_its_frames_and_runs_again(beam, tmp_path, rng):
    changed(beam, "substeps: 24", "substeps: 4000")
    finish(start("simulate", beam, "--out", tmp_path / "whole"))
    (whole,) = (tmp_path / "whole").glob("*/*")
    out = tmp_path / "killed"
    process = start("simulate", beam, "--out", out)
    part = "*/*/trajectory.h5.part"
    deadline = time.monotonic() + PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        parts = list(out.glob(part))
        if parts and len(read_trajectory(parts[0]).time) >= 3:
            break
    process.kill()
    process.communicate()
    (file,) = out.glob(part)
    seen = read_trajectory(file)
    assert not seen.complete
    kept, expected = len(seen.time), read_trajectory(whole / "trajectory.h5")
    assert 3 <= kept < len(expected.time)
    for name in "xvJ":
        np.testing.assert_array_equal(seen.fields[name], expected.fields[name][:kept])
    assert read_record(file.parent)["status"] == "running"
    finish(start("resume", file.parent))
    assert_same(file.parent, whole)

"""Problems with run directories and disks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_beam import BEAM, FIT, assert_same, result_of

from cqrun import __version__
from cqrun.fingerprint import engine_hash
from cqrun.jobs.sysid import run_sysid
from cqrun.store.run import RunDirectory, read_record

ROOT = Path(__file__).parents[2]
ADAM = "optimizer={adam: {max_iterations: 4}}"


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> dict[str, Path]:
    """Return a finished run of each kind of optimizer."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "fit.yaml").write_text(BEAM + FIT)
    overrides = {"least_squares": [], "adam": [ADAM]}
    return {name: run_sysid(folder / "fit.yaml", o, folder, threads=1) for name, o in overrides.items()}


@pytest.fixture(scope="module")
def separate_run(finished, tmp_path_factory) -> Path:
    """Return the same least-squares run made by separate processes, which load compiled kernels from the cache.

    The last bits of Numba's results differ between the process that compiles the code and one that loads it.
    """
    scene, out = finished["least_squares"].parents[1] / "fit.yaml", tmp_path_factory.mktemp("separate_run")
    for words in (["warmup", scene], ["sysid", scene, "--out", out, "--threads", "1", "--quiet"]):
        subprocess.run([sys.executable, "-m", "cqrun", *map(str, words)], check=True, cwd=ROOT, capture_output=True)
    (run,) = (out / "fit").iterdir()
    return run


@pytest.fixture
def run_of(finished, tmp_path):
    """Return a function that copies the run of an optimizer and may change its status."""

    def copy(name: str, *, status: str | None = None) -> Path:
        run = tmp_path / "fit" / finished[name].name
        shutil.copytree(finished[name], run)
        if status is not None:
            change_record(run, status=status)
        return run

    return copy


def change_record(run: Path, **changes: str) -> None:
    (run / "run.json").write_text(json.dumps(read_record(run) | changes))


# --- runs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["resume", "plot"])
def test_a_directory_that_is_not_a_run(cqrun, tmp_path, run_of, command):
    code, _, err = cqrun(command, tmp_path / "none")
    assert code == 2
    assert f"{tmp_path / 'none'}: no run (it has no run.json); a run is a directory results/<scene>/<12 hex" in err
    run = run_of("adam")
    code, _, err = cqrun(command, run.parent)
    assert code == 2
    assert f"; it holds runs: {run}" in err


def test_a_record_that_cannot_be_read(cqrun, run_of):
    run = run_of("adam")
    (run / "run.json").write_text('{"status": "conv')
    code, _, err = cqrun("resume", run)
    assert code == 2
    assert "run.json: unreadable (" in err
    assert "run the scene again with --fresh" in err


def test_a_run_of_another_engine(cqrun, run_of, finished, tmp_path):
    run = run_of("adam")
    change_record(run, engine="0123456789ab")
    scene = finished["adam"].parents[1] / "fit.yaml"
    for words in (("resume", run), ("sysid", scene, "-o", ADAM, "--out", tmp_path)):
        code, _, err = cqrun(*words)
        assert code == 2
        assert f"made by another engine (cqrun {__version__}, engine 0123456789ab; this is {engine_hash()})" in err
        assert "--fresh" in err
        assert "--out DIR" in err
    assert cqrun("sysid", scene, "-o", ADAM, "--out", tmp_path, "--fresh", "--quiet", "--threads", 1)[0] == 0
    assert_same(run, finished["adam"])


def test_a_job_of_another_version(cqrun, run_of):
    run = run_of("adam")
    change_record(run, job="sculpt")
    code, _, err = cqrun("resume", run)
    assert code == 2
    assert "a run of 'sculpt', which this version of cqrun does not know" in err


@pytest.mark.parametrize("command", ["resume", "sysid"])
def test_a_second_process_on_the_same_run(cqrun, run_of, finished, tmp_path, command):
    run = run_of("adam", status="stopped")
    scene = finished["adam"].parents[1] / "fit.yaml"
    words = {"resume": ("resume", run), "sysid": ("sysid", scene, "-o", ADAM, "--out", tmp_path)}[command]
    with RunDirectory.resume(run):
        code, _, err = cqrun(*words)
    assert code == 2
    assert f"{run}: another process works on this run (pid {os.getpid()} on " in err
    assert "give --out DIR for a run of your own" in err
    assert cqrun(*words, "--quiet")[0] == 0  # after the first has released it, the run continues


@pytest.mark.parametrize("name", ["least_squares", "adam"])
def test_a_checkpoint_that_cannot_be_read(cqrun, run_of, finished, name):
    run = run_of(name, status="stopped")
    for file in run.glob("evals*"):
        file.write_bytes(b"nothing that cqrun wrote")
    code, _, err = cqrun("resume", run)
    assert code == 2
    assert "unreadable checkpoint" in err
    assert "start the run over with --fresh" in err
    assert read_record(run)["status"] == "stopped"


@pytest.mark.parametrize("name", ["least_squares", "adam"])
def test_the_incomplete_end_of_a_checkpoint_is_computed_again(cqrun, run_of, finished, name):
    run = run_of(name, status="stopped")
    file = max(run.glob("evals*"), key=lambda path: path.stat().st_mtime_ns)
    file.write_bytes(file.read_bytes()[:-7])
    code, _, err = cqrun("resume", run, "--threads", 1)
    assert code == 0, err
    assert_same(run, finished[name])
    assert "evals" in (run / "log.txt").read_text()


def test_a_result_that_cannot_be_read(cqrun, run_of):
    run = run_of("adam")
    (run / "result.json").write_text("{")
    code, _, err = cqrun("resume", run)
    assert code == 2
    assert "result.json: unreadable (" in err


# --- disks ----------------------------------------------------------------------------------------------


def mounted(script: str, tmp_path: Path, *, options: str) -> subprocess.CompletedProcess[str]:
    """Run a shell script with a small file system mounted at $DISK; skip if none can be mounted."""
    disk = tmp_path / "disk"
    disk.mkdir()
    spaces = ["--mount"] if os.geteuid() == 0 else ["--user", "--map-root-user", "--mount"]
    mount = f"mount -t tmpfs -o {options} tmpfs {disk}"
    unshare = shutil.which("unshare")
    if unshare is None:
        pytest.skip("there is no `unshare`, so no small disk can be mounted")
    tried = subprocess.run([unshare, *spaces, "sh", "-c", mount], capture_output=True, text=True, check=False)
    if tried.returncode != 0:
        pytest.skip(f"no small disk can be mounted here: {tried.stderr.strip()}")
    environment = {**os.environ, "DISK": str(disk), "PYTHONPATH": str(ROOT), "CQRUN": f"{sys.executable} -m cqrun"}
    return subprocess.run(
        [unshare, *spaces, "sh", "-c", f"{mount} && {script}"],
        capture_output=True, text=True, check=False, cwd=ROOT, env=environment,
    )  # fmt: skip


@pytest.mark.parametrize("kib", [12, 48, 96])
def test_a_run_on_a_full_disk_can_be_continued(separate_run, finished, tmp_path, kib):
    """The disk fills up at different moments; with more space the run gives bit-for-bit identical results."""
    scene = finished["least_squares"].parents[1] / "fit.yaml"
    script = (
        f"$CQRUN sysid {scene} --out $DISK --threads 1 --quiet; echo code $? >&2; "
        "mount -o remount,size=64m $DISK; "
        f"$CQRUN sysid {scene} --out $DISK --threads 1 --quiet && cp -r $DISK/fit/* {tmp_path}/kept"
    )
    done = mounted(script, tmp_path, options=f"size={kib}k")
    assert "code 1\n" in done.stderr, done.stderr
    assert "the disk is full" in done.stderr
    assert "Free some space and give the same command again, or choose another disk with --out" in done.stderr
    assert "resume" not in done.stderr
    assert "Traceback" not in done.stderr
    assert done.returncode == 0, done.stderr
    assert_same(tmp_path / "kept", separate_run)


def test_a_read_only_disk(finished, tmp_path):
    scene = finished["adam"].parents[1] / "fit.yaml"
    done = mounted(f"$CQRUN sysid {scene} --out $DISK; echo code $?", tmp_path, options="ro")
    assert done.stdout == "code 2\n"
    assert "cannot be written (Read-only file system); choose another place with --out" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_directory_that_may_not_be_written(cqrun, finished, tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere; the test of the read-only disk covers this")
    scene, out = finished["adam"].parents[1] / "fit.yaml", tmp_path / "out"
    out.mkdir(mode=0o555)
    code, _, err = cqrun("sysid", scene, "--out", out)
    assert code == 2
    assert "cannot be written (Permission denied); choose another place with --out" in err


def test_a_file_in_place_of_the_output_directory(cqrun, finished, tmp_path):
    scene = finished["adam"].parents[1] / "fit.yaml"
    (tmp_path / "out").write_text("")
    code, _, err = cqrun("sysid", scene, "--out", tmp_path / "out")
    assert code == 2
    assert err.endswith("cannot be made (File exists); choose another place with --out\n")


def test_results_end_with_the_path_of_the_run(cqrun, run_of):
    run = run_of("least_squares")
    code, out, _ = cqrun("resume", run)
    assert code == 0
    assert out.splitlines()[-1] == f"run: {run}"
    assert out.startswith(f"{result_of(run)['status']} after ")

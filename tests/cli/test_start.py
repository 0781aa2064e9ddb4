"""The start of the process: the current folder, the user's environment, and signals before and after the work."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hangup import NOT_UNDER_NOHUP
from small_beam import BEAM, FIT, assert_same
from small_finger import FINGER

from cqrun.cli.start import NUMBA_FILE

ROOT = Path(__file__).parents[2]
SHORT = "time.duration=0.02"
LIBRARIES = ("yaml", "numpy", "pydantic", "rich", "platformdirs", "numba", "matplotlib", "typer", "h5py")
PATIENCE = 600.0
"""Longest that one process may take [s]."""

OUTSIDE = {"PYTHONPATH": str(ROOT), "NUMBA_NUM_THREADS": "1", "CQRUN_PICTURES": "1"}


def start(*words: str | Path, folder: Path, python: tuple[str, ...] = (), **variables: str) -> subprocess.Popen[str]:
    """Start `cqrun words...` in a folder, as the console script does unless Python gets other options."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "MPL", "LC_", "LANG"))}
    command = [sys.executable, *(python or ("-P", "-m", "cqrun")), *map(str, words)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = clean | OUTSIDE | variables
    return subprocess.Popen(command, cwd=folder, env=environment, encoding="utf-8", errors="surrogateescape", **pipes)


def run(*words: str | Path, folder: Path, **options: object) -> tuple[int, str, str]:
    """Return exit code, standard output and standard error of a command."""
    process = start(*words, folder=folder, **options)
    out, err = process.communicate(timeout=PATIENCE)
    assert "Traceback" not in err, err
    return process.returncode, out, err


def but_for_warnings(err: str) -> list[str]:
    """Return the lines on standard error, without the warnings about thin bodies."""
    return [line for line in err.splitlines() if not line.startswith("warning: ")]


@pytest.fixture
def folder(tmp_path):
    """Return a folder with a scene, and files that call themselves like libraries."""
    (tmp_path / "beam.yaml").write_text(BEAM)
    (tmp_path / "finger.yaml").write_text(FINGER)
    for name in LIBRARIES:
        (tmp_path / f"{name}.py").write_text(f"import os; os.close(os.open('was-run-{name}', os.O_CREAT)); 1/0\n")
    return tmp_path


# --- the current folder ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("python", "path"),
    [
        ((), str(ROOT)),
        (("-m", "cqrun"), str(ROOT)),
        (("-P", "-m", "cqrun"), f":{ROOT}:"),
        (("-P", "-m", "cqrun"), f".{os.pathsep}{ROOT}"),
    ],
    ids=["script", "module", "empty entries", "relative entry"],
)
def test_nothing_is_imported_from_the_current_folder(folder, python, path):
    code, out, err = run("simulate", "beam.yaml", "-o", SHORT, "-q", folder=folder, python=python, PYTHONPATH=path)
    assert (code, but_for_warnings(err)) == (0, [])
    assert "figures/bodies.png" in out
    assert not list(folder.glob("was-run-*"))


@pytest.mark.slow
def test_runs_of_a_study_import_nothing_from_the_current_folder(folder):
    words = ("control", "finger.yaml", "--seeds", "1", "-o", "optimizer.adam.max_iterations=1", "-q", "--threads", "1")
    code, out, err = run(*words, folder=folder)
    assert (code, but_for_warnings(err)) == (0, [])
    assert "1 of 1 seeds learned" in out
    assert not list(folder.glob("was-run-*"))


def test_a_python_that_a_library_starts_imports_nothing_from_the_current_folder(folder):
    """As pyvista does, to ask VTK what it can draw."""
    code = (
        "from cqrun.cli.start import leave_the_current_folder; leave_the_current_folder();"
        "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import yaml'], check=True)"
    )
    for path in (str(ROOT), f":{ROOT}"):
        assert run(folder=folder, python=("-c", code), PYTHONPATH=path)[0] == 0
    assert not list(folder.glob("was-run-*"))


def test_a_checkout_that_is_not_installed_finds_itself(tmp_path):
    (tmp_path / "cqrun").symlink_to(ROOT / "cqrun")
    code = (
        f"import sys; sys.path[:] = [p for p in sys.path if 'cqrun' not in p and p != {str(tmp_path)!r}];"
        f"from cqrun.cli import start; start.ROOT = {str(tmp_path)!r}; start.leave_the_current_folder();"
        f"import os; assert sys.path[-1] == os.environ['PYTHONPATH'] == {str(tmp_path)!r}, sys.path;"
        "assert '' not in sys.path"
    )
    assert run(folder=tmp_path, python=("-c", code), PYTHONPATH="") == (0, "", "")


# --- the environment ------------------------------------------------------------------------------------------------

ENVIRONMENT = {
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    "PYTHONWARNINGS": "error",
    "NUMBA_OPT": "0",
    "NUMBA_BOUNDSCHECK": "1",
    "OMP_NUM_THREADS": "many",
    "OPENBLAS_NUM_THREADS": "4",
    "LC_ALL": "en_US.ISO-8859-1",
    "PYTHONUTF8": "0",
    "PYTHONIOENCODING": "ascii",
    "COLUMNS": "1",
    "MPLCONFIGDIR": "/proc/none",
    "PYTHONOPTIMIZE": "2",
    "PYTHONHASHSEED": "7",
    "HDF5_USE_FILE_LOCKING": "TRUE",
}


@pytest.mark.slow
def test_the_users_environment_changes_no_result(tmp_path):
    (tmp_path / "fit.yaml").write_text("# Länge\n" + BEAM.replace("a small cantilever", "ein Stäbchen") + FIT)
    words = ("sysid", "fit.yaml", "-o", "optimizer.least_squares.max_iterations=2", "--threads", "1")
    assert run(*words, "--out", "plain", folder=tmp_path)[0] == 0
    code, out, err = run(*words, "--out", "other", folder=tmp_path, **ENVIRONMENT)
    assert code == 0, err
    assert "warning: NUMBA_BOUNDSCHECK, NUMBA_OPT in the environment: not used" in err
    assert "figures/convergence.png" in out
    (plain,), (other,) = tmp_path.glob("plain/fit/*"), tmp_path.glob("other/fit/*")
    assert_same(other, plain)
    assert (other / "figures" / "tracks_synthetic.png").read_bytes() == (
        plain / "figures" / "tracks_synthetic.png"
    ).read_bytes()
    code, out, err = run("resume", other, folder=tmp_path, **ENVIRONMENT)
    assert code == 0, err


THREADS = (
    "from cqrun.cli.start import set_environment\nprint(set_environment())\n"
    "import os\nos.sched_getaffinity = lambda _: range(8)\n"
    "from cqrun.running.threads import cores\nprint(cores(None), cores(5))"
)


@pytest.mark.parametrize(
    ("value", "warning", "threads"),
    [("3", "", 3), ("64", "", 8), ("0", "NUMBA_NUM_THREADS", 8), ("many", "NUMBA_NUM_THREADS", 8)],
)
def test_numbas_number_of_threads_is_the_largest_if_none_is_given(tmp_path, value, warning, threads):
    code, out, err = run(folder=tmp_path, python=("-c", THREADS), NUMBA_NUM_THREADS=value)
    assert (code, err) == (0, "")
    told, numbers = out.splitlines()
    assert told == (f"{warning} in the environment: not used, as results would depend on it" if warning else "")
    assert numbers == f"{threads} 5"


def test_a_file_of_settings_for_numba_is_not_read(tmp_path):
    (tmp_path / NUMBA_FILE).write_text("opt: 0\n")
    code, _, err = run("--version", folder=tmp_path)
    assert code == 2
    assert err.startswith("error: .numba_config.yaml: Numba would read this file, and results would depend on it")


@pytest.mark.slow
def test_a_folder_whose_name_is_not_utf8_is_a_folder_like_any_other(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    (folder / "fit.yaml").write_text(BEAM + FIT)
    (folder / "finger.yaml").write_text(FINGER)
    for words in (
        ("validate", folder / "fit.yaml"),
        ("sysid", folder / "fit.yaml", "-o", "optimizer={adam: {max_iterations: 1}}"),
        ("control", folder / "finger.yaml", "--seeds", "1", "-o", "optimizer.adam.max_iterations=1"),
    ):
        code, out, err = (
            run(*words, "--out", folder / "out", folder=folder)
            if words[0] != "validate"
            else run(*words, folder=folder)
        )
        assert code == 0, err
        assert "caf\udce9" in out
    (fit,) = folder.glob("out/fit/*")
    for words in (("plot",), ("render", "--png"), ("resume",), ("simulate", "--out", folder / "again")):
        code, out, err = run(words[0], fit, *words[1:], folder=folder)
        assert code == 0, err
    code, _, err = run("simulate", folder / "none.yaml", folder=folder)
    assert (code, "caf\udce9/none.yaml: the scene cannot be read" in err) == (2, True)


# --- signals --------------------------------------------------------------------------------------------------------


def catches(process: subprocess.Popen[str], number: int) -> bool:
    """Return whether a process has a handler for a signal."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    caught = next(int(line.split()[1], 16) for line in lines if line.startswith("SigCgt"))
    return bool(caught >> (number - 1) & 1)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the handlers of a process are read from /proc")
@pytest.mark.parametrize(
    ("number", "code", "name"),
    [
        (signal.SIGINT, 130, "SIGINT (Ctrl-C)"),
        (signal.SIGTERM, 75, "SIGTERM"),
        pytest.param(signal.SIGHUP, 75, "SIGHUP", marks=NOT_UNDER_NOHUP),
    ],
)
@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_a_signal_while_libraries_are_imported_is_answered(tmp_path, number, code, name, delay):
    (tmp_path / "beam.yaml").write_text(BEAM)
    process = start("simulate", "beam.yaml", folder=tmp_path)
    while not catches(process, signal.SIGTERM):
        time.sleep(0.001)
    time.sleep(delay)
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out) == (code, ""), err
    # a fast machine may have begun the run by then
    assert err.splitlines()[-1].startswith(f"error: {name}")
    assert ": stopped before it" in err.splitlines()[-1]
    assert "Traceback" not in err
    assert not list(tmp_path.glob("results/*/*/run.json"))

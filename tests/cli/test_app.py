"""The command for its users: help, versions, exit codes, errors without a traceback."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import metadata

import pytest

from cqrun import __version__
from cqrun.cli import app as cli
from cqrun.cli.terminal import echo
from cqrun.errors import CqrunError, Problem, RolloutError, RunError, SceneError, Stopped, UsageError

NAMES = [
    "new",
    "sysid",
    "control",
    "codesign",
    "simulate",
    "rest",
    "sweep",
    "gradcheck",
    "resume",
    "validate",
    "describe",
    "schema",
    "plot",
    "render",
    "report",
    "export",
    "compress",
    "material",
    "bench",
    "warmup",
    "doctor",
]


def run(capsys, *words: str) -> tuple[int, str, str]:
    """Return exit code, standard output and standard error of `cqrun words...`."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(words))
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def test_help_and_version_import_nothing_heavy():
    code = (
        "import sys\n"
        "from cqrun.cli.app import main\n"
        "try: main([sys.argv[1]])\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print('heavy:', [m for m in ('numba', 'scipy', 'matplotlib', 'h5py') if m in sys.modules])\n"
    )
    for option in ("--help", "--version"):
        command = [sys.executable, "-c", code, option]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "heavy: []"


def test_python_dash_m_runs_the_command():
    command = [sys.executable, "-m", "cqrun", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"cqrun {__version__} (numba {metadata.version('numba')}, ")


@pytest.mark.parametrize("name", NAMES)
def test_each_command_has_help(capsys, name):
    code, out, err = run(capsys, name, "-h")
    assert (code, err) == (0, "")
    assert f"Usage: cqrun {name}" in out


def test_there_are_no_other_commands():
    assert [command.__name__ for command in cli.COMMANDS] == NAMES


@pytest.mark.parametrize("name", ["sysid", "control", "codesign", "simulate", "rest", "sweep", "gradcheck"])
def test_jobs_share_their_options(capsys, name):
    out = run(capsys, name, "--help")[1]
    for option in ("-o", "--out", "--fresh", "--threads", "--quiet"):
        assert re.search(rf"(^|\s){option}\b", out, re.MULTILINE), option


@pytest.mark.parametrize("words", [["sysyd"], ["sysid"], ["simulate", "a.yaml", "--threads", "0"], ["--nonsense"]])
def test_bad_usage_ends_with_2(capsys, words):
    code, out, err = run(capsys, *words)
    assert (code, out) == (2, "")
    assert "Usage: cqrun" in err


def test_an_error_is_one_sentence_with_an_exit_code(capsys):
    code, out, err = run(capsys, "describe", "elastik")
    assert (code, out) == (2, "")
    assert err.startswith("error: nothing is called 'elastik' (did you mean 'elastic'?); kinds: shape, ")
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("error", "code"),
    [(CqrunError, 1), (RunError, 1), (UsageError, 2), (Stopped, 75)],
)
def test_exit_codes(capsys, monkeypatch, error, code):
    def ends(*_, **__):
        raise error("the reason")

    monkeypatch.setattr(cli, "app", ends)
    assert run(capsys) == (code, "", "error: the reason\n")


def test_a_blown_up_rollout_ends_with_1(capsys, monkeypatch):
    def ends(*_, **__):
        raise RolloutError("v is not finite", body="beam", particle=7, time=0.25, advice="halve the step")

    monkeypatch.setattr(cli, "app", ends)
    message = "error: body 'beam', particle 7, t = 0.25 s: v is not finite; halve the step\n"
    assert run(capsys) == (1, "", message)


def test_a_scene_error_starts_with_its_place(capsys, monkeypatch):
    def ends(*_, **__):
        raise SceneError([Problem("a.yaml:3:5", "world.dx", "must be greater than 0"), Problem("-o x=1", "", "no")])

    monkeypatch.setattr(cli, "app", ends)
    assert run(capsys) == (2, "", "a.yaml:3:5: world.dx: must be greater than 0\n-o x=1: no\n")


def test_a_tilde_means_home_in_options(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    given: list[list[str]] = []
    monkeypatch.setattr(cli, "app", lambda words, **_: given.append(words) or sys.exit(0))
    run(
        capsys, "simulate", "~/a.yaml", "--out=~/results", "--controller", "~", "-o", "title=~", "--x=a~", "--y=~none/b"
    )
    home = str(tmp_path)
    expected = ["simulate", f"{home}/a.yaml", f"--out={home}/results", "--controller", home, "-o", "title=~", "--x=a~"]
    assert given == [[*expected, "--y=~none/b"]]


def test_errors_and_lines_do_not_control_the_terminal(capsys, monkeypatch):
    def ends(*_, **__):
        raise UsageError("marker 'a\x1b[2J\rb'\nsecond line")

    monkeypatch.setattr(cli, "app", ends)
    assert run(capsys) == (2, "", "error: marker 'a\\x1b[2J\\rb'\nsecond line\n")
    echo("title \x1b]0;mine\x07 \N{RIGHT-TO-LEFT OVERRIDE}end")
    assert capsys.readouterr().out == "title \\x1b]0;mine\\x07 \\u202eend\n"


def test_a_bug_keeps_its_traceback(monkeypatch):
    def ends(*_, **__):
        raise ZeroDivisionError

    monkeypatch.setattr(cli, "app", ends)
    with pytest.raises(ZeroDivisionError):
        cli.main([])

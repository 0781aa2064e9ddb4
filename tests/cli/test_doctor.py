"""`cqrun doctor`: what it checks, and that it fails if the machine is not fit."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from cqrun.cli.app import app
from cqrun.cli.doctor import REQUIREMENT, _write_problem


def test_doctor_succeeds_on_this_machine(tmp_path):
    done = CliRunner().invoke(app, ["doctor", "--out", str(tmp_path / "not" / "yet")])
    assert done.exit_code == 0, done.output
    for name in ("engine", "Python", "cores", "memory", "kernel cache", "results", "threads", "test kernel"):
        assert f"\n{name} " in done.output
    assert "right, " in done.output
    assert not (tmp_path / "not").exists()


def test_doctor_fails_if_results_cannot_be_written(tmp_path):
    blocker = tmp_path / "file"
    blocker.write_text("")
    done = CliRunner().invoke(app, ["doctor", "--out", str(blocker / "results")])
    assert done.exit_code == 1
    assert "NOT WRITABLE" in done.output
    assert _write_problem(tmp_path) == ""


@pytest.mark.parametrize(
    ("text", "name", "extra"),
    [
        ("numpy<2.6,>=2.4", "numpy", None),
        ("types-pyyaml<7,>=6.0.12; extra == 'dev'", "types-pyyaml", "dev"),
        ('tomli>=2; python_version < "3.11" and extra == "dev"', "tomli", "dev"),
    ],
)
def test_requirements_are_parsed(text, name, extra):
    assert REQUIREMENT.match(text).groups() == (name, extra)

"""Plug-in files on the command line: refused, allowed, described, and kept in the run."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from plugin_sandbox import DISC, sandbox
from small_beam import BEAM, FIT, changed

import cqrun as package
from cqrun.cli.app import app
from cqrun.errors import SceneError
from cqrun.store.run import read_record

RULE = '''\
from pydantic import Field

from cqrun.optimizers.descent import Descent
from cqrun.plugin.registry import plugin


@plugin("optimizer", "sign_descent")
class SignDescent(Descent):
    """Steps of the same length downhill in every coordinate."""

    learning_rate: float = Field(0.01, gt=0, description="Length of the steps")

    def memory_names(self):
        return ()

    def direction(self, iteration, grad, memory):
        return (grad > 0) * 1.0 - (grad < 0) * 1.0, memory
'''
"""A user's own optimizer: a plug-in without kernels."""


@pytest.fixture(autouse=True)
def _sandbox() -> Iterator[None]:
    with sandbox():
        yield


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Return a small fit with a user's own optimizer."""
    (tmp_path / "rule.py").write_text(RULE)
    scene = tmp_path / "fit.yaml"
    scene.write_text(BEAM + FIT)
    changed(scene, "world:", "plugins: [rule.py]\nworld:")
    return changed(scene, "{least_squares: {max_iterations: 8}}", "{sign_descent: {max_iterations: 2}}")


@pytest.mark.parametrize("command", ["sysid", "simulate", "gradcheck", "validate", "warmup"])
def test_every_command_that_reads_a_scene_asks_for_permission(cqrun, scene, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    code, out, err = cqrun(command, scene)
    assert (code, out) == (2, "")
    assert err.startswith(f"{scene}:4:1: plugins: this scene wants to run Python files of its own: rule.py")
    assert not (tmp_path / "results").exists()


def test_with_permission_the_scene_is_valid(cqrun, scene):
    code, out, _ = cqrun("validate", scene, "--allow-plugins")
    assert code == 0
    assert "sign_descent, at most 2 iterations" in out
    code, _, err = cqrun("validate", scene)  # the next command asks again
    assert code == 2
    assert "--allow-plugins" in err


def test_a_run_continues_with_its_own_copy(cqrun, scene, tmp_path):
    code, out, _ = cqrun("sysid", scene, "--allow-plugins", "--quiet", "--threads", "1", "--out", tmp_path / "out")
    assert code == 0
    run = Path(re.search(r"^run: (.*)$", out, re.M).group(1))
    assert (run / "plugins" / "rule.py").read_text() == RULE
    (tmp_path / "rule.py").unlink()
    more = ("-o", "optimizer.sign_descent.max_iterations=4", "--quiet", "--threads", "1")
    code, _, err = cqrun("resume", run, *more)
    assert code == 2
    assert err.startswith(f"{run / 'scene.yaml'}:")
    assert "wants to run Python files of its own: rule.py" in err
    code, _, err = cqrun("resume", run, *more, "--allow-plugins")
    assert code == 0, err
    assert len((run / "history.csv").read_text().splitlines()) == 1 + 5
    assert cqrun("plot", run)[0] == 2
    assert cqrun("plot", run, "--allow-plugins")[0] == 0
    (run / "plugins" / "rule.py").write_text(RULE.replace("0.01", "0.02"))
    code, _, err = cqrun("resume", run, "--allow-plugins")
    assert code == 2
    assert "this copy of a plug-in has changed since the run began" in err
    assert read_record(run)["status"] == "iteration_limit"


def test_the_name_of_a_run_depends_on_the_content_of_its_plug_ins(cqrun, scene, tmp_path):
    for text in (RULE, RULE.replace("0.01", "0.02")):
        (tmp_path / "rule.py").write_text(text)
        assert cqrun("simulate", scene, "--allow-plugins", "-q", "--threads", "1", "--out", tmp_path / "out")[0] == 0
    assert len(list((tmp_path / "out").glob("fit/*/run.json"))) == 2


def test_describe_and_schema_with_a_plug_in_file(cqrun, tmp_path):
    (tmp_path / "disc.py").write_text(DISC)
    assert cqrun("describe", "disc")[0] == 2
    code, out, _ = cqrun("describe", "disc", "--plugin", tmp_path / "disc.py")
    assert code == 0
    assert "shape: disc" in out
    assert "radius: [m], number, > 0, required" in out
    code, out, _ = cqrun("schema", "--plugin", tmp_path / "disc.py")
    assert "shape.disc" in json.loads(out)["$defs"]
    code, _, err = cqrun("schema", "--plugin", tmp_path / "none.py")
    assert (code, err) == (2, f"error: {tmp_path / 'none.py'}: cannot be read (No such file or directory)\n")


def test_python_callers_need_permission_too(scene):
    with pytest.raises(SceneError, match="allow_plugins=True"):
        package.load(scene)
    experiment = package.load(scene, allow_plugins=True)
    assert experiment.scene.optimizer.name == "sign_descent"
    with pytest.raises(SceneError, match="allow_plugins=True"):
        package.load(scene)


def test_every_command_that_takes_a_scene_or_a_run_has_the_option():
    takes, reads_no_scene = {}, {"compress"}  # it reads only the trajectory of a run
    for command in app.registered_commands:
        names = list(command.callback.__annotations__)
        if {"scene", "scenes", "run", "runs"} & set(names) and command.callback.__name__ not in reads_no_scene:
            takes[command.callback.__name__] = "allow_plugins" in names
    assert len(takes) >= 7
    assert all(takes.values()), takes

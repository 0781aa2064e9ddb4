"""The worked examples of CONTRIBUTING.md, run as they stand: a kernel plug-in and a NumPy plug-in."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np
import pytest
from made_matter import made_matter
from made_tracks import a_track, adjoint_error
from numba import config
from plugin_sandbox import sandbox

from cqrun.cli.describe import _lines
from cqrun.objectives.term import Over
from cqrun.plugin import registry

ROOT = Path(__file__).parents[1]
NAME = "st_venant_kirchhoff"
THETA = (2.0e5, 0.3)

whole_job = pytest.mark.skipif(bool(config.DISABLE_JIT), reason="a whole job takes minutes without the compiler")


def section(number: int) -> str:
    """Return the text of an example of the page."""
    page = (ROOT / "CONTRIBUTING.md").read_text()
    (text,) = re.findall(rf"^## Example {number}: .*?(?=^## |\Z)", page, re.M | re.S)
    return text


def block(language: str, number: int = 1) -> str:
    """Return the only block of a language in an example of the page."""
    (text,) = re.findall(rf"^```{language}\n(.*?)^```$", section(number), re.M | re.S)
    return text


@pytest.fixture
def source() -> str:
    return block("python")


@contextmanager
def part_of_the_package(name: str, source: str, folder: Path) -> Iterator[ModuleType]:
    """Import an example as the part of the package it would be, and forget it afterwards."""
    with sandbox(), pytest.MonkeyPatch.context() as patch:
        path = folder / f"{name.rpartition('.')[2]}.py"
        path.write_text(source)
        spec = importlib.util.spec_from_file_location(name, path)
        module = importlib.util.module_from_spec(spec)
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
        yield module


@pytest.fixture
def example(source, tmp_path) -> Iterator[ModuleType]:
    with part_of_the_package(f"cqrun.materials.{NAME}", source, tmp_path) as module:
        yield module


def cqrun(*words: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run `cqrun words...` from this source tree in a folder, in a separate process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "cqrun", *map(str, words)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def run_of(done: subprocess.CompletedProcess[str], folder: Path) -> Path:
    """Return the path of the run that a command has printed."""
    assert done.returncode == 0, done.stderr
    return folder / re.search(r"^run: (.*)$", done.stdout, re.M).group(1)


@pytest.fixture
def folder(source, tmp_path) -> Path:
    """Return a user's folder with the two files of the example."""
    (tmp_path / f"{NAME}.py").write_text(source)
    (tmp_path / "scene.yaml").write_text(block("yaml"))
    return tmp_path


SIMULATE = ("simulate", "scene.yaml", "--threads", "1", "--quiet")


@whole_job
def test_the_example_runs_with_permission(folder):
    refused = cqrun(*SIMULATE, folder=folder)
    assert refused.returncode == 2
    assert refused.stderr.startswith("scene.yaml:2:1: plugins: this scene wants to run Python files of its own")
    run = run_of(cqrun(*SIMULATE, "--allow-plugins", folder=folder), folder)
    beam = json.loads((run / "result.json").read_text())["bodies"]["beam"]
    assert 0.19 < beam["fastest"] < 0.23  # the tip of a clamped beam is a little faster than free fall, 0.196 m/s
    assert (run / "plugins" / f"{NAME}.py").read_bytes() == (folder / f"{NAME}.py").read_bytes()
    (folder / f"{NAME}.py").unlink()
    again = cqrun("resume", run, "--allow-plugins", "--quiet", folder=folder)
    assert run_of(again, folder) == run


@pytest.mark.slow
@whole_job
def test_a_changed_law_is_compiled_again_and_other_scenes_are_not_affected(folder, monkeypatch):
    """All use one cache, which is empty at the start: no old code is used, and no scene loads another's classes."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "cache"))
    text, law = (folder / "scene.yaml").read_text(), (folder / f"{NAME}.py").read_text()

    def end(scene: str, source: str) -> float:
        (folder / "scene.yaml").write_text(scene)
        (folder / f"{NAME}.py").write_text(source)
        run = run_of(cqrun(*SIMULATE, "--allow-plugins", folder=folder), folder)
        return json.loads((run / "result.json").read_text())["bodies"]["beam"]["centroid"][1]

    stiff = law.replace("return mul_bt(mul(F, S), F)", "return scale(mul_bt(mul(F, S), F), 4.0)")
    assert stiff != law
    plain = re.sub(r"^plugins.*\n", "", text, flags=re.M).replace(NAME, "fixed_corotated")
    first = end(text, law)
    assert abs(end(text, stiff) - first) > 5e-5
    assert abs(end(plain, law) - first) < 5e-6  # the laws agree where the strain is small
    assert end(text, law) == first
    folders = [path.name for path in (folder / "cache").glob("plugins-*")]
    assert len(folders) == 2


def test_the_example_is_registered_and_described(example):
    assert NAME in registry.plugins("elastic")
    text = "\n".join(_lines("elastic", NAME))
    assert "youngs_modulus: [Pa], number, > 0, required, differentiable" in text


@pytest.mark.parametrize("number", [1, 2])
def test_it_obeys_the_linter(number, tmp_path):
    path = tmp_path / "example.py"
    path.write_text(block("python", number))
    command = [sys.executable, "-m", "ruff", "check", "--config", str(ROOT / "pyproject.toml"), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("dim", [2, 3])
def test_rest_and_small_strain(example, rng, dim):
    rest, zero = tuple(np.eye(dim).ravel()), (0.0,) * dim**2
    np.testing.assert_allclose(example.stress(None, THETA, rest, zero), 0.0, atol=1e-9)
    e = rng.standard_normal((dim, dim)) * 1e-7
    mu, lam = THETA[0] / 2.6, THETA[0] * 0.3 / (1.3 * 0.4)
    hooke = mu * (e + e.T) + lam * np.trace(e) * np.eye(dim)
    tau = example.stress(None, THETA, tuple((np.eye(dim) + e).ravel()), zero)
    np.testing.assert_allclose(np.reshape(tau, (dim, dim)), hooke, atol=1e-6 * np.abs(hooke).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_the_adjoint_agrees_with_complex_step(example, rng, dim):
    n, h = dim**2, 1e-30
    F = np.eye(dim).ravel() + 0.3 * rng.standard_normal(n)
    tau_bar, F_dot, theta_dot = rng.standard_normal(n), rng.standard_normal(n), rng.standard_normal(2) * THETA
    moved = example.stress(None, tuple(THETA + 1j * h * theta_dot), tuple(F + 1j * h * F_dot), (0.0,) * n)
    theta_bar, F_bar, C_bar = example.stress_vjp(None, THETA, tuple(F), (0.0,) * n, tuple(tau_bar))
    forward = np.dot(np.imag(moved) / h, tau_bar)
    assert np.dot(F_bar, F_dot) + np.dot(theta_bar, theta_dot) == pytest.approx(forward, rel=1e-12)
    assert C_bar == (0.0,) * n


# --- the NumPy plug-in ------------------------------------------------------------------------------------


@pytest.fixture
def level(tmp_path) -> Iterator[type]:
    """Return the objective of the second example, as a part of the package."""
    with part_of_the_package("cqrun.objectives.level", block("python", 2), tmp_path) as module:
        yield module.Level


@pytest.fixture
def table(tmp_path) -> Path:
    """Return a user's folder, with the two files of the second example."""
    (tmp_path / "level.py").write_text(block("python", 2))
    (tmp_path / "level.yaml").write_text(block("yaml", 2))
    return tmp_path


def test_the_objective_is_found_and_described(level):
    assert registry.plugins("objective")["level"] is level
    text = "\n".join(_lines("objective", "level"))
    assert "groups: list of text, required" in text


@pytest.mark.parametrize("over", get_args(Over))
@pytest.mark.parametrize("dim", [2, 3])
def test_dot_product_of_the_objective(level, dim, over, rng):
    """The line that the page adds to the generated tests, with what they ask."""
    (line,) = re.findall(r'^    "level": (\[.*\]),$', section(2), re.M)
    for fields in ast.literal_eval(line):
        bound = level.model_validate(fields | {"over": over}).bind(made_matter(dim))
        track = a_track(bound.rows.shape[0], dim, rng)
        assert adjoint_error(bound.value, bound.value_vjp, track, rng) <= 1e-9


def test_a_level_body_costs_nothing(level, rng):
    bound = level.model_validate({"body": "arm", "groups": ["left", "tip"]}).bind(made_matter(2))
    track = a_track(2, 2, rng)
    track.x[-1, :, 1] = [0.3, 0.1]
    assert bound.value(track) == pytest.approx(0.04)
    track.x[-1, :, 1] = 0.2
    assert bound.value(track) == 0.0


@pytest.mark.slow
@whole_job
def test_the_table_learns_to_be_level(table):
    words = ("level.yaml", "--allow-plugins", "--quiet", "--threads", "1")
    told = re.search(r"falls from (\S+) to (\S+) m\^2", section(2)).groups()
    result = json.loads((run_of(cqrun("control", *words, folder=table), table) / "result.json").read_text())
    learned = [f"{result[when]['terms']['level']:.2g}" for when in ("start", "trained")]
    assert [float(number) for number in learned] == [float(number) for number in told]
    done = cqrun("gradcheck", *words, folder=table)
    assert done.returncode == 0, done.stdout
    assert "adjoint and differences agree" in done.stdout


def test_a_group_that_the_table_has_not_is_an_error(table):
    (table / "level.yaml").write_text(block("yaml", 2).replace("right_end]", "right_and]"))
    done = cqrun("validate", "level.yaml", "--allow-plugins", folder=table)
    assert done.returncode == 2
    assert "right_and" in done.stderr
    assert "right_end" in done.stderr

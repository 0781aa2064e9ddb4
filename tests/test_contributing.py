"""The worked example of CONTRIBUTING.md, run as it stands."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from cqrun import registry
from cqrun.cli.describe import _lines

ROOT = Path(__file__).parents[1]
NAME = "st_venant_kirchhoff"
THETA = (2.0e5, 0.3)


@pytest.fixture
def source() -> str:
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / "CONTRIBUTING.md").read_text(), re.M | re.S)
    assert len(blocks) == 1
    return blocks[0]


@pytest.fixture
def example(source, tmp_path, monkeypatch) -> ModuleType:
    """Import the example as the plug-in it would be, and forget it afterwards."""
    registry.plugins("elastic")  # so that what is known before is known afterwards
    known = {kind: dict(names) for kind, names in registry._PLUGINS.items()}
    monkeypatch.setattr(registry, "_PLUGINS", known)
    path = tmp_path / f"{NAME}.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location(f"cqrun.materials.{NAME}", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def test_it_is_found_and_described(example):
    assert NAME in registry.plugins("elastic")
    text = "\n".join(_lines("elastic", NAME))
    assert "youngs_modulus: [Pa], number, > 0, required, differentiable" in text


def test_it_obeys_the_linter(source, tmp_path):
    path = tmp_path / f"{NAME}.py"
    path.write_text(source)
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
def test_its_adjoint_agrees_with_complex_step(example, rng, dim):
    n, h = dim**2, 1e-30
    F = np.eye(dim).ravel() + 0.3 * rng.standard_normal(n)
    tau_bar, F_dot, theta_dot = rng.standard_normal(n), rng.standard_normal(n), rng.standard_normal(2) * THETA
    moved = example.stress(None, tuple(THETA + 1j * h * theta_dot), tuple(F + 1j * h * F_dot), (0.0,) * n)
    theta_bar, F_bar, C_bar = example.stress_vjp(None, THETA, tuple(F), (0.0,) * n, tuple(tau_bar))
    forward = np.dot(np.imag(moved) / h, tau_bar)
    assert np.dot(F_bar, F_dot) + np.dot(theta_bar, theta_dot) == pytest.approx(forward, rel=1e-12)
    assert C_bar == (0.0,) * n

"""A material term with history, as a plug-in file (tests/relaxation.py), in all that the state goes through."""

from __future__ import annotations

import copy
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import reference
from little_worlds import Extra, needs_jit
from plugin_sandbox import sandbox
from rich_scene import direction, make_complex, moved, parts, product, random_records, random_state, rich
from small_beam import assert_same, result_of

from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Records
from cqrun.plugin.registry import plugins
from cqrun.scene.load import load_scene
from cqrun.scene.plugin_files import plugins_allowed

ROOT = Path(__file__).parents[2]
FILE = ROOT / "tests" / "relaxation.py"
STRAIN = "relaxation.strain"
SCENE = f"""\
cqrun: 1
plugins: ["{FILE}"]
world: {{size: [0.4, 0.3], dx: 0.02, gravity: [0, -9.81], frame: updated}}
bodies:
  beam:
    shape: {{box: {{corner: [0.02, 0.16], size: [0.2, 0.04]}}}}
    particles_per_cell: 4
    material:
      density: 1000
      elastic: {{neo_hookean: {{youngs_modulus: 5.0e4, poissons_ratio: 0.3}}}}
      relaxation: {{modulus: 2.0e4, time: 0.05}}
boundaries:
  clamp: {{sticky: {{region: {{box: {{corner: [0, 0], size: [0.06, 0.3]}}}}}}}}
time: {{duration: 0.06, control_step: 0.01}}
"""
FIT = """\
data:
  synthetic:
    truth: {bodies.beam.material.relaxation.modulus: 3.0e4, bodies.beam.material.relaxation.time: 0.03}
    markers: {tip: [0.21, 0.18], middle: [0.14, 0.18]}
    every: 1
    noise: 1.0e-5
unknowns:
  bodies.beam.material.relaxation.modulus: {bounds: [5.0e3, 1.0e5], scale: log}
  bodies.beam.material.relaxation.time: {bounds: [0.01, 0.3], scale: log}
optimizer: {least_squares: {max_iterations: 8}}
"""
KINDS = ("modulus", "time", STRAIN)
TINY = 1e-30


@pytest.fixture(scope="module", autouse=True)
def _loaded() -> Iterator[None]:
    """Load the plug-in file; kernels that know it are cached apart from all others."""
    with sandbox(), plugins_allowed():
        load_scene(SCENE)
        yield


def relaxing(dim: int, **options: Any) -> tuple[Any, Inputs]:
    """Return the rich model of the engine's tests with one more term, and its inputs."""
    spec, rng = plugins("material_term")["relaxation"](modulus=1.0, time=1.0), np.random.default_rng(11)
    fields = tuple(field._replace(name=STRAIN) for field in spec.history(dim))
    theta = np.array([rng.uniform(2, 3, 47), rng.uniform(0.01, 0.03, 47)])
    return rich(dim, extra=Extra(spec.kernel_term, theta, fields), **options)


def arrays(inputs: Inputs) -> dict[str, np.ndarray]:
    """Return what the term adds to the inputs, or to a cotangent."""
    return dict(zip(KINDS, (*inputs.terms[0][4], inputs.state.history[STRAIN]), strict=True))


def pushed(inputs: Inputs, kind: str, change: np.ndarray) -> Inputs:
    """Return inputs with one kind moved, complex where the change is."""
    if kind not in KINDS:
        return moved(inputs, kind, change)
    other = copy.deepcopy(inputs)
    if np.iscomplexobj(change):
        make_complex(other)
    arrays(other)[kind][...] += change
    return other


def gradient(model: Any, inputs: Inputs, threads: int = 1) -> tuple[Any, Records, Inputs, Any]:
    """Return random cotangents, the records and the gradient."""
    rng = np.random.default_rng(7)
    records_bar = random_records(Records.zeros(model.n_controls, 3, model.dim, model.layout.history), rng)
    bars = LossBar(records_bar, random_state(inputs.state, rng))
    records, bar = make_rollout(model, inputs, threads=threads, adjoint=True).gradient(lambda records, state: bars)
    return bars, records, bar, model


@pytest.fixture(scope="module")
def plane() -> tuple[Any, Inputs]:
    return relaxing(2)


@pytest.fixture(scope="module")
def adjoint(plane) -> tuple[Any, Records, Inputs, Any]:
    return gradient(*plane)


def test_a_rollout_is_that_of_the_equations(plane):
    model, inputs = plane
    seen = {}
    records = make_rollout(model, inputs).run(observe=seen.__setitem__)
    expected, last, _ = reference.rollout(model, inputs)
    pairs = [*zip(parts(records), parts(expected), strict=True)]
    pairs += zip(parts(seen[model.n_controls]), parts(last), strict=True)
    for a, b in pairs:
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())
    assert np.abs(records.history[STRAIN][-1] - records.history[STRAIN][0]).max() > 1e-3


def dot_product(model: Any, inputs: Inputs, kind: str, bars: LossBar, bar: Inputs, rng: np.random.Generator) -> None:
    values = arrays(inputs)
    change = rng.normal(size=values[kind].shape) * values[kind] if kind in values else direction(inputs, kind, rng)
    records, last, _ = reference.rollout(model, pushed(inputs, kind, 1j * TINY * change))
    forward = (product(records, bars.records) + product(last, bars.final)).imag / TINY
    cotangent = arrays(bar)[kind] if kind in values else getattr(bar.state, kind)
    assert (cotangent * change).sum() == pytest.approx(forward, rel=1e-9), kind


@pytest.mark.parametrize("kind", [*KINDS, "x", "v", "F"])
def test_dot_product(plane, adjoint, kind, rng):
    dot_product(*plane, kind, adjoint[0], adjoint[2], rng)


@needs_jit
def test_dot_product_in_space(rng):
    model, inputs = relaxing(3, controls=2)
    bars, _, bar, _ = gradient(model, inputs)
    for kind in (*KINDS, "F"):
        dot_product(model, inputs, kind, bars, bar, rng)


@pytest.mark.parametrize("kind", KINDS)
def test_taylor_remainder_through_a_whole_rollout_is_of_second_order(plane, adjoint, kind, rng):
    model, inputs = plane
    bars, _, bar, _ = adjoint

    def loss(given: Inputs) -> float:
        seen = {}
        records = make_rollout(model, given).run(observe=seen.__setitem__)
        return float(product(records, bars.records) + product(seen[model.n_controls], bars.final))

    change = rng.normal(size=arrays(inputs)[kind].shape) * arrays(inputs)[kind]
    slope, start = float((arrays(bar)[kind] * change).sum()), loss(inputs)
    steps = 2.0 ** -np.arange(5, 13)
    remainders = [abs(loss(pushed(inputs, kind, h * change)) - start - h * slope) for h in steps]
    order = np.log2(np.array(remainders[:-1]) / np.array(remainders[1:]))
    assert np.max(order[:5]) > 1.9
    assert np.median(order[:5]) == pytest.approx(2.0, abs=0.15)


@needs_jit
def test_states_that_are_not_kept_are_computed_again_to_the_same_bits(adjoint):
    model, inputs = relaxing(2, substeps=16)
    short = replace(model, memory_budget=12 * model.layout.table.n_rows * model.layout.n * 8)
    _, records, bar, _ = gradient(model, inputs)
    _, again, bar_again, _ = gradient(short, inputs, threads=2)
    for a, b in zip(parts(records), parts(again), strict=True):
        np.testing.assert_array_equal(a, b)
    for kind in KINDS:
        np.testing.assert_array_equal(arrays(bar)[kind], arrays(bar_again)[kind])


@needs_jit
def test_in_float32_it_is_nearly_the_same(plane, adjoint):
    model, inputs = plane
    _, records, bar, _ = gradient(replace(model, real=np.float32), inputs)
    for a, b in zip(parts(records), parts(adjoint[1]), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-4 * np.abs(b).max())
    for kind in KINDS:
        expected = arrays(adjoint[2])[kind]
        np.testing.assert_allclose(arrays(bar)[kind], expected, rtol=0, atol=5e-3 * np.abs(expected).max())


# --- as a user has it: a plug-in file beside a scene --------------------------------------------------------


def cqrun(*words: str | Path) -> subprocess.Popen[str]:
    """Start `cqrun words... --allow-plugins` on this source tree."""
    command = [sys.executable, "-m", "cqrun", *map(str, words), "--threads", "1", "--quiet", "--allow-plugins"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, **pipes)


def finish(process: subprocess.Popen[str]) -> None:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, out + err


FRAMES = {
    "updated": "frame: updated",
    "reference": "frame: reference",
    "averaged": "frame: reference, volume: averaged",
}


def framed(name: str) -> str:
    """Return the scene in one frame."""
    return SCENE.replace("frame: updated", FRAMES[name])


@needs_jit
@pytest.mark.parametrize("frame", FRAMES)
def test_the_trajectory_file_has_the_history(frame, tmp_path):
    (tmp_path / "scene.yaml").write_text(framed(frame))
    finish(cqrun("simulate", tmp_path / "scene.yaml", "--out", tmp_path))
    (path,) = tmp_path.glob("scene/*/trajectory.h5")
    built, seen = build(load_scene(framed(frame))), {}
    make_rollout(built.model, built.assembly.inputs({})).run(observe=seen.__setitem__)
    with h5py.File(path) as file:
        strain = file["particles"][STRAIN][:]
    assert strain.shape == (7, len(built.particles.x))
    for k, state in seen.items():
        np.testing.assert_array_equal(strain[k], state.history[STRAIN].astype(np.float32))
    assert np.ptp(strain[-1]) > 1e-4


@needs_jit
@pytest.mark.parametrize("frame", ["updated", "averaged"])
def test_a_fit_that_is_killed_goes_on_to_the_same_bits(frame, tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(framed(frame) + FIT)
    finish(cqrun("sysid", scene, "--out", tmp_path / "whole"))
    process = cqrun("sysid", scene, "--out", tmp_path / "killed")
    rows = 0
    while rows < 3 and process.poll() is None:  # the head and two iterations
        rows = sum(file.read_text().count("\n") for file in (tmp_path / "killed").glob("*/*/history.csv"))
        time.sleep(0.002)
    process.kill()
    out, err = process.communicate()
    assert process.returncode == -signal.SIGKILL, out + err
    (run,) = (tmp_path / "killed").glob("*/*")
    assert not (run / "result.json").exists()
    finish(cqrun("resume", run))
    (whole,) = (tmp_path / "whole").glob("*/*")
    assert_same(whole, run)
    found = result_of(run)["unknowns"]["bodies.beam.material.relaxation.modulus"]["value"]
    assert found == pytest.approx(3.0e4, rel=0.05)

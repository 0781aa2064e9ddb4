"""A measurement of a user's own, one file beside a scene: adjoint, fit, interval, table, picture, kill and resume."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from plugin_sandbox import sandbox
from small_beam import BEAM, E_PATH, MARKERS, assert_same, changed, record, result_of

from cqrun.build.model import build
from cqrun.cli.describe import _lines
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Records
from cqrun.errors import SceneError
from cqrun.figures import draw
from cqrun.figures.draw import draw_run
from cqrun.figures.losses import loss_curve
from cqrun.figures.run_data import read_run
from cqrun.fingerprint import has_kernels
from cqrun.fitting.cases import given_cases
from cqrun.fitting.problem import FitProblem
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema_json import scene_json_schema

PLUGIN = Path(__file__).with_name("mean_strain.py")
ROOT = Path(__file__).parents[2]
TRUE, START, STRAIN_NOISE = 4.0e4, 0.025, 2e-4
"""Young's modulus that the data are made with [Pa], time in the file when the run begins [s], noise [1]."""

DATA = """\
plugins: [mean_strain.py]
regions: {top: {box: {corner: [0.04, 0.065], size: [0.04, 0.005]}}}
data:
  recordings:
    gauge: {file: strain.csv, start: 0.025, length: 0.07, mean_strain: {group: top}}
unknowns:
  bodies.beam.material.elastic.fixed_corotated.youngs_modulus: {bounds: [1.0e4, 1.0e5], scale: log}
optimizer: {least_squares: {max_iterations: 10}}
"""


@pytest.fixture(autouse=True)
def _sandbox() -> Iterator[None]:
    with sandbox(), plugins_allowed():
        yield


def strains(modulus: float) -> np.ndarray:
    """Return the mean of F_xx - 1 over the top of the beam at every control step (T + 1,)."""
    built = build(load_scene(BEAM + DATA[DATA.index("regions:") : DATA.index("data:")]))
    seen: list[float] = []
    top = built.particles.inside("beam", "top")
    rollout = make_rollout(built.model, built.assembly.inputs({E_PATH: np.array(modulus)}))
    rollout.run(lambda control, state: seen.append(state.F[top, 0, 0].mean() - 1.0))
    return np.array(seen)


@pytest.fixture(scope="module")
def measured() -> tuple[np.ndarray, np.ndarray]:
    """Return times in the file and strains with noise, the beam at rest before `START`."""
    clock = 0.001 * np.arange(121)
    exact = np.interp(clock - START, 0.01 * np.arange(11), strains(TRUE))
    return clock, exact + STRAIN_NOISE * np.random.default_rng(3).standard_normal(len(clock))


@pytest.fixture
def scene(tmp_path: Path, measured: tuple[np.ndarray, np.ndarray]) -> Path:
    """Return a scene beside its plug-in and its recording."""
    shutil.copy(PLUGIN, tmp_path)
    with (tmp_path / "strain.csv").open("w") as file:
        file.write("time,strain\n")
        file.writelines(f"{t!r},{e!r}\n" for t, e in zip(*(column.tolist() for column in measured), strict=True))
    path = tmp_path / "strained.yaml"
    path.write_text(BEAM + DATA)
    return path


def problem_of(scene: Path, *overrides: str) -> FitProblem:
    built = build(load_scene(scene, overrides))
    cases = given_cases(built)
    assert cases is not None
    return FitProblem(cases, make_params(built))


def fitted(scene: Path, out: Path, *overrides: str) -> Path:
    return run_sysid(scene, overrides, out, threads=1)


# --- the adjoint ----------------------------------------------------------------------------------------------


def test_its_loss_has_the_adjoint_of_a_dot_product(scene, rng):
    (case,) = problem_of(scene).cases
    (gauge,) = case.comparisons
    shape = case.runner.still()
    records, direction = (Records(*(rng.normal(size=part.shape) for part in shape)) for _ in range(2))
    bar, start_bar = gauge.loss_vjp(records, 0.0253, 1.7)

    def loss(h: float, late: float = 0.0) -> float:
        moved = Records(*(a + h * d for a, d in zip(records, direction, strict=True)))
        return 1.7 * gauge.loss(moved, 0.0253 + late)

    along = sum(float(np.sum(a * d)) for a, d in zip(bar, direction, strict=True))
    assert along == pytest.approx((loss(1.0) - loss(-1.0)) / 2.0, rel=1e-9)  # exact: the loss is quadratic
    late = 1e-5  # no frame passes a control step meanwhile, so along the start it is quadratic, too
    assert start_bar == pytest.approx((loss(0.0, late) - loss(0.0, -late)) / (2.0 * late), rel=1e-7)


def test_taylor_through_a_whole_rollout(scene):
    problem = problem_of(scene, "unknowns.data.recordings.gauge.start={bounds: [0.02, 0.03]}")
    x, d = problem.start + 0.013, np.array([1.0, -0.3])
    value, gradient = problem.value_and_grad(x)
    steps = 1e-4 * 0.5 ** np.arange(4)
    left = [abs(problem.value(x + h * d) - value - h * float(gradient @ d)) for h in steps]
    assert np.diff(np.log(left)).max() / np.log(0.5) > 1.9


def test_gradcheck_agrees(scene, tmp_path):
    run, agrees = run_gradcheck(scene, [], tmp_path / "out", threads=1)
    lines = report_lines(run)
    assert agrees, "\n".join(lines)
    assert lines[0].startswith("gradient of the fit's loss, in units of 0.0")
    assert "m^2" not in lines[0]  # strain has no unit


# --- the fit --------------------------------------------------------------------------------------------------


def test_the_modulus_is_found_with_an_interval_a_table_and_a_picture(scene, tmp_path):
    run = fitted(scene, tmp_path / "out")
    result = result_of(run)
    found = result["unknowns"][E_PATH]
    low, high = found["interval"]
    assert low < TRUE < high
    assert high - low < 0.05 * TRUE
    assert found["value"] == pytest.approx(TRUE, rel=0.01)
    entry = result["recordings"]["gauge"]
    assert entry == {"holdout": False, "rmse": pytest.approx(STRAIN_NOISE, rel=0.2), "gauges": {"top": entry["rmse"]}}

    with (run / "mean_strain.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head == ["recording", "gauge", "time", "data_strain", "model_strain"]
    assert {row[0] for row in rows} == {"gauge"}
    errors = np.array([[float(number) for number in row[3:]] for row in rows])
    assert np.sqrt(np.mean((errors[:, 0] - errors[:, 1]) ** 2)) == pytest.approx(entry["rmse"], rel=1e-9)
    assert not (run / "tracks.csv").exists()

    text = "\n".join(report_lines(run))
    assert f"gauge      fitted  {entry['rmse']:.4g}" in text
    assert "see mean_strain.csv, trajectory.h5" in text
    assert run / "figures" / "tracks_gauge.png" in draw_run(run)


def test_the_picture_says_strain(scene, tmp_path, monkeypatch):
    figures = {}
    monkeypatch.setattr(draw, "save", lambda figure, base, kinds: figures.update({base.name: figure}) or [base])
    run = fitted(scene, tmp_path / "out", "optimizer.least_squares.max_iterations=1")
    draw_run(run)
    strain, error = figures["tracks_gauge"].axes
    assert (strain.get_ylabel(), error.get_ylabel()) == ("strain", "error")
    np.testing.assert_array_equal(strain.lines[0].get_ydata()[:3], read_run(run).tracks()[0].data[:3, 0, 0])
    assert loss_curve(read_run(run)).title == "RMSE"


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", ["least_squares: {max_iterations: 10}", "lbfgs: {max_iterations: 10}"])
def test_killed_and_resumed_it_is_the_same_to_the_bit(scene, tmp_path, optimizer):
    given = f"optimizer={{{optimizer}}}"
    whole = fitted(scene, tmp_path / "whole", given)
    process = started("sysid", scene, "-o", given, "--out", tmp_path / "killed")
    rows, deadline = 0, time.monotonic() + 120.0
    while rows < 3 and process.poll() is None and time.monotonic() < deadline:  # the head and two iterations
        rows = sum(file.read_text().count("\n") for file in (tmp_path / "killed").glob("*/*/history.csv"))
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    out, err = process.communicate()
    assert process.returncode == -signal.SIGKILL, out + err
    (run,) = (tmp_path / "killed").glob("*/*")
    assert not (run / "result.json").exists()
    out, err = (process := started("resume", run)).communicate(timeout=120.0)
    assert process.returncode == 0, out + err
    assert_same(run, whole)


def started(*words: str | Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "cqrun", *map(str, words), "--threads", "1", "--quiet", "--allow-plugins"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, **pipes)


# --- beside others --------------------------------------------------------------------------------------------


def test_strain_and_markers_in_one_fit_count_by_what_each_shows(scene, tmp_path):
    """Loss 1 is that of a beam that does not move, in both; a weight doubles one's part."""
    (file,) = record(tmp_path / "made.yaml", tmp_path / "data")
    tip = f"data.recordings.tip={{file: {file}, length: 0.1, markers: {MARKERS}}}".replace("'", "")
    problem = problem_of(scene, tip, "data.recordings.tip.weight=2")
    assert problem.unit == pytest.approx(1.0)
    gauge, markers = (case.still_losses() for case in problem.cases)
    np.testing.assert_allclose([problem.weights[0] * gauge, problem.weights[1] * markers], [[1 / 3], [2 / 3]])
    x = problem.start
    r = problem.residuals(x)
    assert problem.value_and_grad(x)[0] == pytest.approx(0.5 * r @ r, rel=1e-12)

    run = fitted(scene, tmp_path / "out", tip)
    found = result_of(run)["recordings"]
    assert found["gauge"].keys() == {"holdout", "rmse", "gauges"}
    assert found["tip"].keys() == {"holdout", "rmse_mm", "markers_mm"}
    assert {path.name for path in run.glob("*.csv")} == {"history.csv", "mean_strain.csv", "tracks.csv"}
    assert {f"tracks_{name}.png" for name in ("gauge", "tip")} < {path.name for path in draw_run(run)}
    assert sum("RMSE [mm]" in line for line in report_lines(run)) == 1


# --- reports --------------------------------------------------------------------------------------------------


def test_validate_tells_of_it(scene):
    lines = list(validate(scene))
    told = "gauge (fitted): 1 gauge, 71 frames from 0.025 to 0.095 s, release at 0.025 s, 100.0% seen"
    assert f"  recording  {told}" in lines
    assert not any("frame" in line and line.startswith("             ") for line in lines)  # no remark


def test_describe_and_the_schema_know_it(scene):
    load_scene(scene)
    assert "measurement mean_strain: Mean of F_xx - 1 over a body" in "\n".join(_lines("measurement", None))
    page = "\n".join(_lines("mean_strain", None))
    assert page.startswith("measurement: mean_strain\n")
    assert "group: text, optional" in page
    definitions = scene_json_schema()["$defs"]
    assert definitions["Recording"]["properties"]["mean_strain"] == {"$ref": "#/$defs/measurement.mean_strain"}
    assert "group" in definitions["measurement.mean_strain"]["properties"]


def test_kernels_that_it_does_not_have_are_not_compiled_anew():
    assert not has_kernels(PLUGIN.read_bytes())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mean_strain: {group: top}", "units: mm, mean_strain: {}", "gauge.units: has no meaning for the measurement"),
        (
            "mean_strain: {group: top}",
            "mean_strain: {}, markers: {}",
            "gauge: must have one measurement; has markers,",
        ),
        ("mean_strain: {", "mean_strian: {", "gauge.mean_strian: unknown key (did you mean 'mean_strain'?)"),
        ("group: top", "grop: top", "gauge.mean_strain.grop: unknown key (did you mean 'group'?)"),
        ("group: top", "group: tip", "gauge.mean_strain.group: there is no group of the body 'beam' 'tip' (did you"),
        (
            "length: 0.07",
            "length: 0.1",
            "gauge: {folder}/strain.csv: the window, 0.025 to 0.125 s (start + length), does not lie",
        ),
        ("strain.csv", "mean_strain.py", "gauge: {folder}/mean_strain.py: no table of times and strains"),
        ("strain.csv", "absent.csv", "gauge.file: there is no file"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(scene, old, new, message):
    changed(scene, old, new)
    with pytest.raises(SceneError) as info:
        list(validate(scene))
    assert f"data.recordings.{message.format(folder=scene.parent)}" in str(info.value)

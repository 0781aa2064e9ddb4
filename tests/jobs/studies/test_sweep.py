"""`cqrun sweep`: a run for every point, in processes of their own, and one table of what was asked and found."""

from __future__ import annotations

import csv
import itertools
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from small_beam import Listener, assert_same
from small_finger import written
from tiny_beam import BEAM, NU, E
from typer.testing import CliRunner

import cqrun
from cqrun.cli.app import app
from cqrun.errors import SceneError, Stopped, UsageError
from cqrun.figures.style import styled
from cqrun.figures.sweep import _figure, draw_sweep
from cqrun.jobs.control import run_control
from cqrun.jobs.rest import REST
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.studies.sweep import SweepOptions, numbers_shown, run_sweep, sweep_lines
from cqrun.store.study import Found, Sweep, SweptRun, read_sweep, write_study


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Return the folder of a sweep of 2 x 2 runs, its file, and what it told."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "beam.yaml").write_text(BEAM)
    listener = Listener()
    options = SweepOptions([f"{E}=4e4,8e4", f"{NU}=0.2:0.4:2"], jobs=2)
    path, good = run_sweep(folder / "beam.yaml", [], folder / "out", options, threads=2, reporter=listener)
    assert good
    return folder, path, listener


def test_every_point_is_a_run_of_its_own_and_a_row_of_the_table(swept):
    _, path, _ = swept
    sweep = read_sweep(path)
    assert [(run.values[E], run.values[NU]) for run in sweep.runs] == [
        (a, b) for a in ("4e4", "8e4") for b in ("0.2", "0.4")
    ]
    rows = list(csv.DictReader(path.with_suffix(".csv").read_text().splitlines()))
    for run, row in zip(sweep.runs, rows, strict=True):
        assert (Path(run.run) / "result.json").is_file()
        assert row[E] == run.values[E]
        assert row["status"] == run.status == "done"
        assert float(row["beam.deflection [m]"]) == run.found["beam.deflection"]
        assert row["run"] == run.run
    sag = [run.found["beam.deflection"] for run in sweep.runs]
    assert len(set(sag)) == 4
    assert min(sag[:2]) > max(sag[2:])
    assert "4 of 4 runs ended" in sweep_lines(path)


def test_a_run_of_a_sweep_is_the_run_of_the_command(swept, tmp_path):
    folder, path, _ = swept
    run = Path(read_sweep(path).runs[1].run)
    words = [sys.executable, "-m", "cqrun", "simulate", str(folder / "beam.yaml"), "-o", f"{E}=4e4", "-o", f"{NU}=0.4"]
    subprocess.run([*words, "-q", "--out", str(tmp_path)], check=True, stdout=subprocess.DEVNULL)
    assert_same(run, tmp_path / "beam" / run.name)


def test_a_wider_sweep_uses_the_runs_that_are_finished(swept):
    folder, path, _ = swept
    before = {run.run: (Path(run.run) / "result.json").stat().st_mtime_ns for run in read_sweep(path).runs}
    options, listener = SweepOptions([f"{E}=4e4,8e4", f"{NU}=0.2,0.3,0.4"], jobs=2), Listener()
    wider, good = run_sweep(folder / "beam.yaml", [], folder / "out", options, threads=2, reporter=listener)
    assert "6 runs of simulate, 2 at once; 4 of 6 runs are there already" in listener.said
    assert good
    assert wider != path
    runs = [run.run for run in read_sweep(wider).runs]
    assert len(runs) == 6
    assert set(before) < set(runs)
    assert before == {run: (Path(run) / "result.json").stat().st_mtime_ns for run in before}


def test_from_python(swept):
    folder, path, _ = swept
    found = cqrun.sweep(folder / "beam.yaml", [f"{E}=4e4,8e4", f"{NU}=0.2,0.4"], out=folder / "out", jobs=2)
    assert [run.found for run in found.runs] == [run.found for run in read_sweep(path).runs]


def test_from_python_runs_lie_beside_the_scene_as_those_of_the_command(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "beam.yaml").write_text(BEAM)
    monkeypatch.chdir(tmp_path)
    found = cqrun.sweep("here/beam.yaml", [f"{E}=4e4"])
    assert Path(found.runs[0].run).resolve().parent == tmp_path / "here" / "results" / "beam"


def test_the_scene_of_a_run_is_swept_beside_it(swept):
    """With its substeps chosen anew, its points are those of the scene's file: finished runs are found again."""
    folder, path, _ = swept
    run, *_ = (Path(run.run) for run in read_sweep(path).runs)
    found = cqrun.sweep(run, [f"{E}=4e4,8e4"], [f"{NU}=0.4", "time.substeps=auto"])
    assert [Path(each.run) for each in found.runs] == [
        run.parent / Path(each.run).name for each in read_sweep(path).runs[1::2]
    ]
    assert [each.found for each in found.runs] == [each.found for each in read_sweep(path).runs[1::2]]
    rest = REST.run(folder / "beam.yaml", [], folder / "out", threads=1)
    found = cqrun.sweep(rest, [f"{E}=4e4"])
    assert (found.job, found.runs[0].status) == ("rest", "done")
    with pytest.raises(UsageError, match="is a run of rest; `cqrun sysid` takes a scene, or a run of sysid, whose"):
        cqrun.sweep(rest, [f"{E}=4e4"], job="sysid")


def test_runs_of_a_sweep_replay_what_a_run_has_learned(tmp_path, in_process):
    """Points are the replays of `cqrun simulate RUN`, whose goals are fixed."""
    trained = run_control(written(tmp_path), ["optimizer.adam.max_iterations=1"], tmp_path / "out", threads=1)
    found = cqrun.sweep(trained, ["time.duration=0.05,0.1"], job="simulate")
    assert [run.status for run in found.runs] == ["done", "done"]
    replay = run_simulate(trained, ["time.duration=0.05"], tmp_path / "out", threads=1)
    assert Path(found.runs[0].run) == replay
    assert (replay / "controller.npz").read_bytes() == (trained / "controller.npz").read_bytes()
    untrained = cqrun.sweep(tmp_path / "finger.yaml", ["time.duration=0.05"], job="simulate", out=tmp_path / "out")
    assert [run.status for run in untrained.runs] == ["done"]
    assert untrained.runs[0].found["loss"] != found.runs[0].found["loss"]


def test_a_wrong_value_is_refused_before_any_run(swept, tmp_path):
    folder, _, _ = swept
    options = SweepOptions([f"{NU}=0.3,0.6"])
    with pytest.raises(SceneError, match=r"at poissons_ratio=0\.6: ") as raised:
        run_sweep(folder / "beam.yaml", [], tmp_path, options)
    assert f"-o {NU}=0.6" in str(raised.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (SweepOptions(["time.duration=0.1"], job="fly"), "--job fly: there is no such job"),
        (SweepOptions(seeds=0), "--seeds 0: must be at least 1"),
        (SweepOptions(["time.duration=0.1"], jobs=0), "--jobs 0: must be at least 1"),
        (SweepOptions(["seed=1"], seeds=2), "-s seed=...: is given twice"),
    ],
)
def test_wrong_options_are_refused(swept, tmp_path, options, message):
    with pytest.raises(UsageError, match=message):
        run_sweep(swept[0] / "beam.yaml", [], tmp_path, options)


@pytest.mark.slow
def test_a_failed_run_is_a_row_and_the_command_fails(swept, tmp_path):
    """A beam that nothing holds leaves the world after 0.2 s."""
    folder, _, _ = swept
    words = ["--out", str(tmp_path), "-s", "time.duration=0.1,0.4", "-o", "boundaries.clamp=null"]
    result = CliRunner().invoke(app, ["sweep", str(folder / "beam.yaml"), *words, "-o", "world.frame=updated"])
    (path,) = (tmp_path / "beam").glob("sweep-*.json")
    good, bad = read_sweep(path).runs
    assert (good.status, bad.status) == ("done", "failed")
    assert bad.reason
    assert result.exit_code == 1
    assert "1 of 2 runs ended" in result.output
    assert f"failed: {bad.run}: {bad.reason}" in result.output
    assert f"warning: duration=0.4 ({bad.run}): {bad.reason}" in result.output
    assert bad.run not in bad.reason


def test_a_stopped_sweep_tells_how_many_are_finished(swept, tmp_path):
    class Impatient(Listener):
        def advance(self, done, total, text):
            self.stop.ask()

    options = SweepOptions([f"{E}=1e4,2e4,3e4"], jobs=1)
    with pytest.raises(Stopped, match="of 3 runs are finished; the same command continues the others"):
        run_sweep(swept[0] / "beam.yaml", [], tmp_path, options, reporter=Impatient())


# --- pictures ---------------------------------------------------------------------------------------------------------


def made(values, found, units=None):
    """Return a sweep of made-up numbers: `values` by axis, `found` by name, one entry per run; `units` of axes."""
    count = len(next(iter(values.values())))
    runs = [
        SweptRun(
            values={path: texts[k] for path, texts in values.items()}, run=f"r{k}", status="done",
            found={name: numbers[k] for name, numbers in found.items() if numbers[k] is not None},
        )
        for k in range(count)
    ]  # fmt: skip
    known = {name: Found(unit="m") for name in found}
    return Sweep(scene="s", job="rest", axes=list(values), units=units, found=known, runs=runs)


KINDS = {
    "lines": made({"a.E": ["1", "10", "100"], "seed": ["0", "0", "0"]}, {"x": [1.0, 2.0, 4.0], "y": [3.0, None, 1.0]}),
    "a map": made({"a": ["1", "1", "2", "2"], "b": ["p", "q", "p", "q"]}, {"x": [1.0, 2.0, 3.0, None]}),
    "parallel": made({"a": ["1", "2"], "b": ["3", "3"], "c": ["p", "q"]}, {"x": [1.0, 2.0], "y": [0.0, 0.0]}),
    "words": made({"a": ["p", "q"]}, {"x": [1.0, 2.0]}),
    "one run": made({"a": ["1"]}, {"x": [1.0]}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_drawn(kind, tmp_path):
    path = tmp_path / "sweep-1.json"
    write_study(path, KINDS[kind])
    (picture,) = draw_sweep(path)
    assert picture == path.with_suffix(".png")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_sweep_without_numbers_has_no_picture(tmp_path):
    path = tmp_path / "sweep-1.json"
    write_study(path, made({"a": ["1", "2"]}, {"x": [None, None]}))
    data = json.loads(path.read_text()) | {"found": {}}
    path.write_text(json.dumps(data))
    assert draw_sweep(path) == []


def test_an_unknown_number_is_refused_with_the_known_ones(tmp_path):
    path = tmp_path / "sweep-1.json"
    write_study(path, KINDS["a map"])
    with pytest.raises(UsageError, match="--show z: no run found it; there are x"):
        draw_sweep(path, ["z"])


STIFFNESS = "actuators.{}.cable.stiffness"


def panels_of(sweep, names):
    """Return the panels of the picture of a sweep, laid out."""
    with styled():
        figure = _figure(sweep, names)
        FigureCanvasAgg(figure).draw()
    return figure.axes


def words_of(panel):
    """Return the texts of both axes' ticks, without empty ones."""
    return [text.get_text() for axis in (panel.xaxis, panel.yaxis) for text in axis.get_ticklabels() if text.get_text()]


def test_axes_have_units_and_short_numbers():
    sweep = made({E: ["3.0e4", "5.0e4", "1.0e5", "5.0e5"]}, {"tip.x": [0.01, 0.02, 0.03, 0.04]}, {E: "Pa"})
    (panel,) = panels_of(sweep, ["tip.x"])
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("youngs_modulus [kPa]", "tip.x [mm]")
    assert {"100", "400"} <= set(words_of(panel))


def test_the_numbers_of_a_map_are_short_and_have_units():
    values = {E: ["3.0e4", "3.0e4", "1.0e5", "1.0e5"], STIFFNESS.format("a"): ["1.0e6", "2.0e6"] * 2}
    sweep = made(values, {"x": [1.0, 2.0, 3.0, 4.0]}, {E: "Pa", STIFFNESS.format("a"): "N/m"})
    panel, bar = panels_of(sweep, ["x"])
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("youngs_modulus [kPa]", "stiffness [N/m]")
    assert words_of(panel) == ["30", "100", "1e6", "2e6"]
    assert bar.get_ylabel() == "x [m]"


def test_long_names_of_vertical_scales_do_not_overlap():
    paths = [STIFFNESS.format(side) for side in ("left_tendon", "right_tendon", "upper_tendon")]
    sweep = made({path: ["1.0e6", "2.0e6"] for path in paths}, {"clamp.largest_force_at_once": [1.0, 2.0]})
    (panel,) = panels_of(sweep, ["clamp.largest_force_at_once"])
    boxes = [label.get_window_extent() for label in panel.get_xticklabels()]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))


def test_long_values_stay_beside_their_map():
    laws = [f"{{{law}: {{youngs_modulus: 3.0e4, poissons_ratio: 0.3}}}}" for law in ("neo_hookean", "fixed_corotated")]
    sweep = made({E: ["1", "1", "2", "2"], "law": laws * 2}, {"x": [1.0, 2.0, 3.0, 4.0]})
    panel, _ = panels_of(sweep, ["x"])
    assert min(text.get_window_extent().x0 for text in panel.get_yticklabels()) > 0.0
    assert len({text.get_text() for text in panel.get_yticklabels()}) == 2


def test_values_that_agree_in_their_short_text_stay_apart():
    beginning = "a_folder/of_shapes/with_long_names/"
    sweep = made(
        {"a": ["1", "1", "2", "2"], "b": [f"{beginning}{beginning}{end}" for end in "pq"] * 2}, {"x": [1.0] * 4}
    )
    panel, _ = panels_of(sweep, ["x"])
    assert len({text.get_text() for text in panel.get_yticklabels()}) == 2


def test_key_paths_that_were_found_are_short():
    sweep = made({"seed": ["0", "1"]}, {E: [1.0, 2.0], NU: [1.0, 2.0], "tip.x.end": [1.0, 2.0]})
    assert list(sweep.titles().values()) == ["seed", "youngs_modulus", "poissons_ratio", "tip.x.end"]


def test_differences_of_rounding_are_not_shown():
    sweep = made({"a": ["1", "2"]}, {"tip.x.largest": [0.0, 2e-16], "tip.x.end": [-0.1, -0.2], "force": [0.0, 2e-16]})
    assert sweep.varying() == ["tip.x.end", "force"]


def test_the_table_shows_what_the_picture_shows(swept):
    _, path, _ = swept
    assert read_sweep(path).units == {E: "Pa", NU: ""}
    head = sweep_lines(path, ["beam.largest_deflection"])[2]
    assert head.split("  ")[:3] == ["youngs_modulus [Pa]", "poissons_ratio", "beam.largest_deflection [m]"]
    assert "beam.deflection" in sweep_lines(path)[2]


def test_an_unknown_number_is_refused_without_pictures_too(swept, monkeypatch):
    folder, _, _ = swept
    monkeypatch.setenv("CQRUN_PICTURES", "0")
    words = ["sweep", str(folder / "beam.yaml"), "-s", f"{E}=4e4,8e4", "-s", f"{NU}=0.2:0.4:2", "--show", "deflection"]
    result = CliRunner().invoke(app, [*words, "--out", str(folder / "out"), "-q"])
    assert isinstance(result.exception, UsageError)
    assert "--show deflection: no run found it" in str(result.exception)


def test_runs_of_another_engine_stay_in_the_table(swept, tmp_path):
    """After an upgrade, their commands would refuse to touch them; they are results all the same."""
    folder, path, _ = swept
    shutil.copytree(folder, tmp_path / "copy")
    for record in (tmp_path / "copy" / "out").glob("*/*/run.json"):
        record.write_text(json.dumps(json.loads(record.read_text()) | {"engine": "older"}))
    listener = Listener()
    options = SweepOptions([f"{E}=4e4,8e4", f"{NU}=0.2:0.4:2"], jobs=2)
    scene = tmp_path / "copy" / "beam.yaml"
    again, good = run_sweep(scene, [], tmp_path / "copy" / "out", options, threads=2, reporter=listener)
    assert good
    assert [run.found for run in read_sweep(again).runs] == [run.found for run in read_sweep(path).runs]
    assert any("4 of 4 runs were made by another engine and are kept" in text for text in listener.said)


def test_without_pictures_of_runs_the_sweep_has_its_own(swept, monkeypatch):
    folder, path, _ = swept
    monkeypatch.setenv("CQRUN_PICTURES", "0")
    path.with_suffix(".png").unlink(missing_ok=True)
    words = ["sweep", str(folder / "beam.yaml"), "-s", f"{E}=4e4,8e4", "-s", f"{NU}=0.2:0.4:2"]
    result = CliRunner().invoke(app, [*words, "--out", str(folder / "out"), "-q"])
    assert result.exit_code == 0, result.output
    assert path.with_suffix(".png").is_file()


def test_what_differs_most_is_shown_first():
    """A tip that goes down hardly moves sideways."""
    runs = [
        SweptRun(
            values={E: f"{k}"}, status="done", run=f"r{k}", found={"tip.x": 1e-6 * k, "tip.y": 0.01 * k, "w": 5.0 * k}
        )
        for k in (1, 2, 3)
    ]
    found = {"tip.x": Found(unit="m"), "tip.y": Found(unit="m"), "w": Found(unit="N")}
    sweep = Sweep(scene="beam", job="simulate", axes=[E], units={E: "Pa"}, found=found, runs=runs)
    assert sweep.varying() == ["tip.y", "w", "tip.x"]


def test_the_name_of_a_measured_quantity_stands_for_its_end():
    found = {"tip.y.end": Found(unit="m"), "tip.y.least": Found(unit="m")}
    sweep = Sweep(scene="beam", job="simulate", axes=[], units={}, found=found, runs=[])
    assert numbers_shown(sweep, ["tip.y.least", "tip.y"]) == ["tip.y.least", "tip.y.end"]
    with pytest.raises(UsageError, match="--show tip: no run found it"):
        numbers_shown(sweep, ["tip"])

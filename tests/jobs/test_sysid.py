"""`cqrun sysid` on a small beam: what it finds, how it goes on, how it ends."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest
from small_beam import E_PATH, SHEAR_PATH, Listener, assert_same, changed, result_of

from cqrun.errors import RunError, SceneError, Stopped, UsageError
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.optimizers.base import TrialFailed
from cqrun.store.history import read_history
from cqrun.store.run import read_record
from cqrun.store.trajectory import read_trajectory

OPTIMIZERS = {
    "least_squares": "optimizer={least_squares: {max_iterations: 8}}",
    "lbfgs": "optimizer={lbfgs: {max_iterations: 12}}",
    "adam": "optimizer={adam: {max_iterations: 12}}",
    "sgd": "optimizer={sgd: {max_iterations: 12, learning_rate: 0.1}}",
}


def identify(scene, out, *overrides, reporter=None, threads=1, fresh=False):
    return run_sysid(scene, overrides, out, fresh=fresh, threads=threads, reporter=reporter)


RMSE_OF_NOISE = 2.0e-5 * math.sqrt(2.0) * 1e3
"""What the truth itself would have [mm]: the length of the noise in two coordinates."""


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Return a finished run."""
    from small_beam import BEAM, FIT

    folder = tmp_path_factory.mktemp("found")
    (folder / "fit.yaml").write_text(BEAM + FIT)
    listener = Listener()
    return identify(folder / "fit.yaml", folder / "out", reporter=listener), listener


def test_it_finds_the_truth_and_how_sure_it_is(found):
    result = result_of(found[0])
    assert (result["job"], result["status"]) == ("sysid", "converged")
    for path, truth, initial in ((E_PATH, 4.0e4, 3.0e4), (SHEAR_PATH, 6.0, 3.0)):
        entry = result["unknowns"][path]
        low, high = entry["interval"]
        assert low < truth < high
        assert low < entry["value"] < high
        assert entry["initial"] == initial
    assert result["unknowns"][E_PATH]["value"] == pytest.approx(4.0e4, rel=0.01)
    assert result["fracture"] == {"beam": 0}
    recording = result["recordings"]["synthetic"]
    assert not recording["holdout"]
    assert recording["rmse_mm"] == pytest.approx(RMSE_OF_NOISE, rel=0.4)
    assert recording["markers_mm"].keys() == {"tip", "middle"}
    assert result["loss"] == pytest.approx((1e-3 * recording["rmse_mm"]) ** 2, rel=1e-9)  # in square metres


def test_the_history_is_in_the_results_units(found):
    run, listener = found
    history, result = read_history(run / "history.csv"), result_of(run)
    assert history["iteration"] == list(range(result["iterations"] + 1))
    assert history["loss"][-1] == pytest.approx(result["loss"], rel=1e-12)
    assert history[f"value:{E_PATH}"][0] == pytest.approx(3.0e4)
    assert history[f"value:{E_PATH}"][-1] == result["unknowns"][E_PATH]["value"]
    assert [update[0] for update in listener.updates] == history["iteration"][1:]
    assert [update[1] for update in listener.updates] == history["loss"][1:]


def test_the_tracks_are_data_and_model(found):
    with (found[0] / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["marker"] for row in rows} == {"tip", "middle"}
    assert len(rows) == 2 * 11
    errors = [math.hypot(*(float(row[f"data_{a}"]) - float(row[f"model_{a}"]) for a in "xy")) for row in rows]
    rmse = math.sqrt(sum(e * e for e in errors) / len(errors))
    assert 1e3 * rmse == pytest.approx(result_of(found[0])["recordings"]["synthetic"]["rmse_mm"], rel=1e-9)


def test_the_report_is_a_table(found):
    lines = report_lines(found[0])
    assert lines[0].startswith("converged after ")
    assert lines[2].split() == ["unknown", "value", "95", "%", "interval", "unit", "from"]
    assert lines[3].split()[0] == E_PATH
    assert lines[3].split()[-2:] == ["Pa", "30000"]
    text = "\n".join(lines)
    assert "found with time.substeps=24: keep that number wherever these values are used" in lines
    assert "synthetic  fitted  0.0" in text
    assert "RMSEs are of distances: the noise of 0.02 mm in each coordinate alone gives 0.0283 mm" in lines
    assert "see tracks.csv, trajectory.h5" in text


def test_the_trajectory_names_the_values_that_it_is_of(found):
    values = {path: entry["value"] for path, entry in result_of(found[0])["unknowns"].items()}
    assert read_trajectory(found[0] / "trajectory.h5").provenance["found"] == values


def test_its_scene_is_replayed_with_the_values(found, tmp_path):
    def position(run):
        return read_trajectory(run / "trajectory.h5").fields["x"]

    run, _ = found
    replay = run_simulate(run, [], tmp_path, threads=1)
    np.testing.assert_array_equal(position(replay), position(run))
    assert f"youngs_modulus: {result_of(run)['unknowns'][E_PATH]['value']}" in (replay / "scene.yaml").read_text()
    again = run_simulate(replay, ["time.duration=0.05"], tmp_path, threads=1)  # of a replay, too
    np.testing.assert_array_equal(position(again), position(run)[:6])
    other = run_simulate(run, [f"{E_PATH}=3.0e4"], tmp_path, threads=1)
    assert "youngs_modulus: 30000.0" in (other / "scene.yaml").read_text()
    assert not np.array_equal(position(other), position(run))


def test_the_same_again_is_finished(found, tmp_path):
    run, _ = found
    listener = Listener()
    assert identify(run.parents[2] / "fit.yaml", run.parents[1], reporter=listener) == run
    assert listener.said == ["finished already (converged); --fresh starts over"]
    assert run_resume(run, [], threads=1, reporter=listener) == run
    assert listener.said[1:] == ["finished already (converged)"]


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_threads_do_not_change_a_bit(fit, tmp_path, name):
    changed(fit, "noise: 2.0e-5", "noise: 2.0e-5\n    copies: 2")
    runs = [identify(fit, tmp_path / str(n), OPTIMIZERS[name], threads=n) for n in (1, 2)]
    assert_same(*runs)


def test_gradients_and_differences_find_the_same_optimum(fit, tmp_path):
    values = []
    for name in ("least_squares", "lbfgs"):
        result = result_of(identify(fit, tmp_path, OPTIMIZERS[name].replace("12", "60").replace("8", "60")))
        assert result["status"] == "converged"
        values.append([result["unknowns"][path]["value"] for path in (E_PATH, SHEAR_PATH)])
    np.testing.assert_allclose(values[0], values[1], rtol=1e-4)


@pytest.mark.parametrize("per", ["group", "particle"])
def test_one_number_a_group_or_particle(fit, tmp_path, per):
    changed(fit, "scale: log}\n  bodies.beam.material.visc", f"scale: log, per: {per}}}\n  bodies.beam.material.visc")
    run = identify(fit, tmp_path, OPTIMIZERS["lbfgs"])
    result, count = result_of(run), {"group": 1, "particle": 40}[per]
    entry = result["unknowns"][E_PATH]
    assert entry["initial"] == [3.0e4] * count
    assert len(entry["value"]) == count
    lines = "\n".join(report_lines(run))
    if per == "group":
        ((low, high),) = entry["interval"]
        assert low < entry["value"][0] < high
        assert f"{E_PATH}[0]" in lines
    else:
        assert entry["interval"] is None
        assert "no intervals: more than 30 unknowns" in lines
        assert "40 numbers" in lines


def test_what_gradients_cost_is_told_and_is_no_part_of_the_result(fit, tmp_path):
    run = identify(fit, tmp_path, OPTIMIZERS["adam"], "memory=128KiB")
    cost = read_record(run)["gradient"]
    assert cost["recompute_factor"] > 1.0
    assert cost["peak_bytes"] <= 128 * 1024
    assert "forward substeps for each substep of the rollout" in (run / "log.txt").read_text()
    assert "gradient" not in result_of(run)


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_stopped_and_resumed_is_never_stopped(fit, tmp_path, name):
    whole = identify(fit, tmp_path / "whole", OPTIMIZERS[name])
    for _ in range(2):
        with pytest.raises(Stopped, match=r"asked to stop .*; `cqrun resume .*` continues") as ended:
            identify(fit, tmp_path, OPTIMIZERS[name], reporter=Listener(stop_after=1))
        assert ended.value.exit_code == 75
    (run,) = (tmp_path / "fit").iterdir()
    assert read_record(run)["status"] == "stopped"
    assert run_resume(run, [], threads=1) == run
    assert_same(run, whole)


@pytest.mark.parametrize("name", ["least_squares", "adam"])
def test_a_finished_run_can_be_extended(fit, tmp_path, name):
    short = identify(fit, tmp_path, OPTIMIZERS[name].replace("12", "3").replace("8", "3"))
    assert result_of(short)["iterations"] == 3
    more = f"optimizer.{name}.max_iterations=5"
    assert run_resume(short, [more], threads=1) == short
    assert result_of(short)["iterations"] == 5
    whole = identify(fit, tmp_path / "whole", OPTIMIZERS[name].replace("12", "5").replace("8", "5"))
    assert_same(short, whole)
    assert len(read_record(short)["extended"]) == 1
    listener = Listener()  # the scene itself says 3, the run has 5: it stays as it is
    assert identify(fit, tmp_path, OPTIMIZERS[name].replace("12", "3").replace("8", "3"), reporter=listener) == short
    told, warned = listener.said
    assert told == "finished already (iteration_limit); --fresh starts over"
    assert warned.endswith("`cqrun resume` has given it more iterations than this scene has; --fresh starts over")


def test_an_extended_run_that_was_stopped_goes_on_extended(fit, tmp_path):
    scene = OPTIMIZERS["adam"].replace("12", "3")
    run = identify(fit, tmp_path, scene)
    with pytest.raises(Stopped):
        run_resume(run, ["optimizer.adam.max_iterations=9"], threads=1, reporter=Listener(stop_after=2))
    assert identify(fit, tmp_path, scene) == run
    assert result_of(run)["iterations"] == 9


def test_a_run_cannot_be_shortened(fit, tmp_path):
    """What was found would be lost, under the name of the scene that asked for more."""
    run = identify(fit, tmp_path, OPTIMIZERS["adam"].replace("12", "3"))
    before = (run / "result.json").read_bytes()
    for fewer in (2, 3):
        with pytest.raises(UsageError, match="the run has done 3 iterations, and can only be extended"):
            run_resume(run, [f"optimizer.adam.max_iterations={fewer}"], threads=1)
    assert (run / "result.json").read_bytes() == before


def test_all_unknowns_at_their_bounds(fit, tmp_path):
    """The truth lies outside: the value has no interval, but the reason."""
    path = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
    run = run_sysid(fit, [f"unknowns={{{path}: {{bounds: [2e4, 3.5e4], scale: log}}}}"], tmp_path, threads=1)
    (entry,) = result_of(run)["unknowns"].values()
    assert (entry["interval"], entry["reason"]) == (None, "at its upper bound")
    assert entry["value"] == pytest.approx(3.5e4, rel=1e-6)


@pytest.mark.parametrize("override", ["time.duration=1", "optimizer.least_squares.step_tolerance=1e-3"])
def test_only_iterations_can_be_extended(found, override):
    with pytest.raises(UsageError, match=r"a run can only be extended \(optimizer.\*.max_iterations\)"):
        run_resume(found[0], [override], threads=1)


def test_a_scene_that_is_not_for_sysid_says_what_is_missing(beam, tmp_path):
    with pytest.raises(SceneError) as info:
        identify(beam, tmp_path)
    assert [(problem.path, problem.message.partition(":")[0]) for problem in info.value.problems] == [
        ("unknowns", "sysid needs it"),
        ("data", "sysid needs it"),
    ]


def test_a_regulariser_is_refused(fit, tmp_path):
    with pytest.raises(SceneError, match=r"regulariser: sysid takes none: it would pull the value towards the start"):
        identify(fit, tmp_path, f"unknowns.{E_PATH}.regulariser=1")


def test_constraints_are_refused(fit, tmp_path):
    with pytest.raises(SceneError, match=r"constraints.light: sysid does not support constraints: bound"):
        identify(fit, tmp_path, "constraints={light: {of: {mass: {body: beam}}, at_most: 1}}")


def test_without_an_optimizer_the_data_choose_one(fit, tmp_path):
    changed(fit, "optimizer: {least_squares: {max_iterations: 8}}", "")
    run = identify(fit, tmp_path)
    assert "least_squares" in (run / "scene.yaml").read_text()
    text = fit.read_text()
    there = "objective: {there: {track: {body: beam, keys: [[0.1, 0.07, 0.055]]}}}\n"
    fit.write_text(text[: text.index("data:")] + there + text[text.index("unknowns:") :])
    run = identify(fit, tmp_path)
    assert "lbfgs" in (run / "scene.yaml").read_text()
    result = result_of(run)
    assert result["recordings"] is None
    assert result["unknowns"][E_PATH]["interval"] is None
    lines = report_lines(run)
    assert "no intervals: a fit to an objective has no noise to compute an interval from" in lines
    assert f"loss {result['loss']:.6g}" in lines


def test_a_truth_that_blows_up_fails_the_run(fit, tmp_path):
    changed(fit, "viscosity.shear: 6\n", "viscosity.shear: 6\n      world.gravity.1: -1.0e5\n")
    with pytest.raises(RunError, match=r"data.synthetic.truth: body 'beam', particle 11 \(group 'root'\), t = "):
        identify(fit, tmp_path)
    (run,) = (tmp_path / "fit").iterdir()
    assert read_record(run)["status"] == "failed"
    with pytest.raises(UsageError, match=r"has identified nothing to replay \(failed: data.synthetic.truth: body"):
        run_simulate(run, [], tmp_path, threads=1)


def test_trials_that_all_fail_end_the_run_with_their_values(fit, tmp_path, monkeypatch):
    from cqrun.fitting.problem import FitProblem

    def fails(self, x):
        values = self.params.describe(x)
        raise TrialFailed("its position is not finite", body="beam", particle=3, time=0.02, values=values)

    monkeypatch.setattr(FitProblem, "residuals", fails)
    with pytest.raises(RunError, match=rf"body 'beam', particle 3, t = 0.02 s: .* trial values: {E_PATH} = 30000"):
        identify(fit, tmp_path)
    (run,) = (tmp_path / "fit").iterdir()
    result = json.loads((run / "result.json").read_text())
    assert (result["status"], result["loss"], result["recordings"]) == ("failed", None, None)
    assert report_lines(run)[0].startswith("failed after 0 iterations")


def test_a_kernel_is_announced_once_for_its_kind(fit, tmp_path, monkeypatch):
    from cqrun.running import kernels

    monkeypatch.setattr(kernels, "set_kernel_cache", lambda: tmp_path / "cache")
    said = []
    for number in (1, 2):
        listener = Listener()
        identify(fit, tmp_path / str(number), reporter=listener)
        said.append(listener.said)
    words = "2D float64, fixed_corotated + viscosity, sticky, forward"
    compiling = f"compiling kernels, up to half a minute (once for scenes of this kind: {words})"
    assert said[0] == [compiling, *said[1]]
    assert said[1][0].startswith("beam: 40 particles, 4 per cell")
    assert said[1][1] == "beam: 1 cell and 2 particles across its thinnest part, 0.01 m"
    lasts = "less than 0.1 s a rollout on one core"
    assert said[1][2:] == [
        f"making data, {lasts}", f"fitting 2 unknowns, {lasts}",
        f"intervals, predictions, trajectory, {lasts}",
    ]  # fmt: skip

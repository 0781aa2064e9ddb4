"""`cqrun simulate`: what it writes, how it stops, how it fails."""

from __future__ import annotations

import csv
import json

import h5py
import numpy as np
import pytest
from small_beam import Listener, assert_same, changed, result_of

from cqrun.errors import RunError, Stopped, UsageError
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.store.run import read_record
from cqrun.store.trajectory import read_trajectory


def simulate(scene, out, *overrides, reporter=None, threads=1, fresh=False):
    return run_simulate(scene, overrides, out, fresh=fresh, threads=threads, reporter=reporter)


def rows(run):
    with (run / "observables.csv").open() as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def test_it_writes_trajectory_observables_and_result(beam, tmp_path):
    run = simulate(beam, tmp_path / "out")
    motion = read_trajectory(run / "trajectory.h5")
    table, result = rows(run), result_of(run)
    assert motion.complete
    np.testing.assert_allclose(motion.time, [row["time"] for row in table], rtol=0, atol=1e-15)
    np.testing.assert_allclose(motion.time, np.arange(11) * 0.01, rtol=0, atol=1e-15)
    x, v, J = (motion.fields[name] for name in "xvJ")
    for k, row in enumerate(table):
        assert [row["beam.x"], row["beam.y"]] == pytest.approx(x[k].mean(0), rel=1e-12)  # all of one mass
        assert row["beam.fastest"] == pytest.approx(np.linalg.norm(v[k], axis=1).max(), rel=1e-6, abs=1e-12)
        assert row["beam.kinetic_energy"] == pytest.approx(0.5 * np.sum(v[k] ** 2) * 1.0 / 40, rel=1e-6, abs=1e-12)
        assert row["beam.least_volume_ratio"] == pytest.approx(J[k].min(), rel=1e-6)
    assert table[-1]["beam.y"] < table[0]["beam.y"] - 0.01
    assert (result["job"], result["status"], result["fracture"]) == ("simulate", "done", {"beam": 0})
    assert result["bodies"]["beam"]["centroid"] == [table[-1]["beam.x"], table[-1]["beam.y"]]
    assert result["bodies"]["beam"]["fastest"] == max(row["beam.fastest"] for row in table)
    text = "\n".join(report_lines(run))
    assert text.startswith("done: 0.1 s simulated\n\nbody  centroid at the end [m]  fastest [m/s]")
    assert text.endswith("see observables.csv, trajectory.h5")


def test_warnings_before_a_run_are_kept_with_it(beam, tmp_path):
    (warning,) = read_record(simulate(beam, tmp_path))["warnings"]
    assert ": bodies.beam.shape: is 1 cell thick at " in warning


def test_progress_is_told_by_simulated_time(beam, tmp_path):
    listener = Listener()
    simulate(beam, tmp_path, reporter=listener)
    assert [part[0] for part in listener.parts] == list(range(11))
    assert listener.parts[-1] == (10, 10, "t = 0.1 of 0.1 s")
    assert listener.said[-1] == "simulating 40 particles, 240 substeps, less than 0.1 s in all on one core"


def test_a_run_in_float32_tells_what_is_rounded_away(beam, tmp_path):
    listener = Listener()
    run = simulate(beam, tmp_path, "precision=float32", "bodies.beam.velocity=[0, -1e-6]", reporter=listener)
    (told,) = [line for line in listener.said if line.startswith("float32 loses motion slower than about")]
    assert told in (run / "log.txt").read_text()
    assert any(line.startswith("warning") and "starts at 1e-06 m/s" in line for line in listener.said)


def test_the_same_again_is_finished_and_fresh_starts_over(beam, tmp_path):
    run = simulate(beam, tmp_path)
    listener = Listener()
    assert simulate(beam, tmp_path, reporter=listener) == run
    assert listener.said == ["finished already (done); --fresh starts over"]
    assert simulate(beam, tmp_path, fresh=True, reporter=listener) == run
    assert listener.parts


def test_a_scene_has_a_run_of_each_job(fit, tmp_path):
    assert simulate(fit, tmp_path) != run_sysid(fit, ["optimizer.least_squares.max_iterations=1"], tmp_path, threads=1)
    assert sorted(read_record(run)["job"] for run in (tmp_path / "fit").iterdir()) == ["simulate", "sysid"]


def test_long_runs_keep_few_frames_and_the_last(beam, tmp_path):
    run = run_simulate(beam, ["trajectory.frames=4"], tmp_path / "few", threads=1)
    assert read_trajectory(run / "trajectory.h5").step.tolist() == [0, 3, 6, 9, 10]
    assert len(rows(run)) == 11


def test_threads_do_not_change_a_bit(beam, tmp_path):
    assert_same(simulate(beam, tmp_path / "1", threads=1), simulate(beam, tmp_path / "2", threads=2))


def test_a_trajectory_does_not_know_when_it_was_written(beam, tmp_path):
    with h5py.File(simulate(beam, tmp_path) / "trajectory.h5") as file:
        times = {"/": h5py.h5o.get_info(file.id).mtime}
        file.visititems(lambda name, item: times.update({name: h5py.h5o.get_info(item.id).mtime}))
    assert len(times) > 20
    assert set(times.values()) == {0}


def test_a_stopped_run_leaves_what_it_has_and_runs_again(beam, tmp_path):
    whole = simulate(beam, tmp_path / "whole")
    message = r"stopped at t = 0.04 s; the trajectory so far is in .*trajectory.h5.part; `cqrun resume .*` runs"
    with pytest.raises(Stopped, match=message) as ended:
        simulate(beam, tmp_path, reporter=Listener(stop_after=5))
    assert ended.value.exit_code == 75
    run = tmp_path / whole.relative_to(tmp_path / "whole")
    assert read_record(run)["status"] == "stopped"
    part = read_trajectory(run / "trajectory.h5")
    assert (part.complete, part.step.tolist()) == (False, [0, 1, 2, 3, 4])
    assert not (run / "result.json").exists()
    assert report_lines(run) == ["simulate: stopped (stopped at t = 0.04 s)"]
    with pytest.raises(UsageError, match=r"-o time.duration=1: a run of simulate cannot be extended"):
        run_resume(run, ["time.duration=1"], threads=1)
    assert run_resume(run, [], threads=1) == run
    assert_same(run, whole)


def test_a_run_that_blows_up_says_which_body_and_when(beam, tmp_path):
    """The beam, free to fall, leaves the world."""
    text = beam.read_text()
    beam.write_text(text[: text.index("boundaries:")] + "time: {duration: 0.3, control_step: 0.01}\n")
    message = r"body 'beam', particle 0 \(group 'root'\), t = 0.\d+ s: left the grid at .*; enlarge the world"
    with pytest.raises(RunError, match=message) as first:
        simulate(beam, tmp_path)
    assert first.value.exit_code == 1
    (run,) = (tmp_path / "beam").iterdir()
    result = result_of(run)
    assert result["status"] == read_record(run)["status"] == "failed"
    assert "left the grid" in result["message"]
    assert 0.05 < result["time"] < 0.3
    assert read_trajectory(run / "trajectory.h5").step[-1] == len(rows(run)) - 1
    with pytest.raises(RunError, match="left the grid"):  # told again, not run again
        simulate(beam, tmp_path)


def test_a_torn_body_is_told(beam, tmp_path):
    """A beam much too soft, one particle a cell, pulled along its axis: what is clamped stays, the rest falls off."""
    changed(beam, "youngs_modulus: 3.0e4", "youngs_modulus: 10")
    changed(beam, "shear: 3", "shear: 0.01")
    changed(beam, "particles_per_cell: 4", "particles_per_cell: 1")
    changed(beam, "size: [0.16, 0.12], dx: 0.01, gravity: [0, -9.81]", "size: [0.3, 0.12], dx: 0.01, gravity: [20, 0]")
    listener = Listener()
    run = simulate(beam, tmp_path, reporter=listener)
    result, table = result_of(run), rows(run)
    assert result["fracture"]["beam"] == max(row["beam.fracture"] for row in table) > 0
    (finding,) = result["findings"]
    assert finding.startswith(f"numerical fracture: {result['fracture']['beam']} of ")
    assert f"warning: {finding}" in listener.said
    assert f"note: {finding}" in report_lines(run)
    assert finding in (run / "log.txt").read_text()


def test_a_body_of_the_reference_frame_stretches_and_does_not_tear(beam, tmp_path):
    changed(beam, "youngs_modulus: 3.0e4", "youngs_modulus: 300")
    changed(beam, "frame: updated", "frame: reference")
    changed(beam, "gravity: [0, -9.81]", "gravity: [20, 0]")
    run = simulate(beam, tmp_path)
    result, last = result_of(run), read_trajectory(run / "trajectory.h5").fields["x"][-1]
    assert np.ptp(last[:, 0]) > 0.15  # it was 0.1 m long
    assert result["fracture"] == {}
    assert not any("fracture" in finding for finding in result["findings"])
    assert "beam.fracture" not in rows(run)[0]


def test_the_record_says_where_it_comes_from(beam, tmp_path):
    record = json.loads((simulate(beam, tmp_path, threads=2) / "run.json").read_text())
    assert (record["job"], record["status"], record["threads"]) == ("simulate", "done", 2)


@pytest.mark.parametrize("frame", ["reference", "updated"])
def test_gent_beyond_its_limit_says_so(frame, beam, tmp_path):
    """It has no stress there, so a shorter substep would not help."""
    law = "bodies.beam.material.elastic={gent: {mu: 2.0e4, jm: 1.0e-3, poissons_ratio: 0.3}}"
    with pytest.raises(RunError) as error:
        simulate(beam, tmp_path, law, f"world.frame={frame}")
    assert "body 'beam', particle" in str(error.value)
    assert "its law `gent` has no stress from I1b - 3 = jm on: if it is stretched so far, give a larger jm" in str(
        error.value
    )

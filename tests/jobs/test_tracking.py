"""`cqrun export RUN --to TRACKER`: what trackers get of a run, and that they can read it."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from little_worlds import needs_jit
from small_beam import BEAM, E_PATH, FIT, SHEAR_PATH, changed, result_of

from cqrun.errors import MissingExtra, UsageError
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.tracking.tracked import MANY, tracked
from cqrun.jobs.tracking.trackers import ID, TRACKERS, export_to
from cqrun.store.history import read_history

pytestmark = needs_jit


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished fit of the small beam, with a picture and a trajectory."""
    scene = tmp_path_factory.mktemp("tracking") / "beam.yaml"
    scene.write_text(BEAM + FIT)
    run = run_sysid(scene, ["optimizer.least_squares.max_iterations=3"], scene.parent / "out", threads=1)
    from cqrun.figures.draw import draw_run

    draw_run(run)
    return run


# --- what they get ----------------------------------------------------------------------------------------------


def test_a_run_gives_its_scene_history_values_and_files(run):
    what, result = tracked(run), result_of(run)
    assert (what.group, what.name) == ("beam", run.name)
    assert what.parameters["world.dx"] == "0.01"
    assert what.parameters["world.size"] == "[0.16, 0.12]"
    assert what.parameters[f"unknowns.{E_PATH}.scale"] == "log"
    assert what.parameters["optimizer.least_squares.max_iterations"] == "3"
    assert not [name for name in what.parameters if name.startswith("goals")]  # which is empty
    assert what.found[E_PATH] == result["unknowns"][E_PATH]["value"]
    assert what.found["loss"] == result["loss"]
    assert what.tags["job"] == "sysid"
    assert {"engine", "status", "version.cqrun", "version.numba", "seed"} <= what.tags.keys()
    assert {"result.json", "history.csv", "scene.yaml", "figures/convergence.png"} <= what.files.keys()
    assert not [name for name in what.files if name.endswith((".h5", ".npz", "lock"))]


def test_the_steps_are_the_history(run):
    rows, steps = read_history(run / "history.csv"), list(tracked(run).steps())
    assert [step for step, _, _ in steps] == [int(k) for k in rows["iteration"]]
    assert [numbers["loss"] for _, numbers, _ in steps] == rows["loss"]
    assert all(before[2] <= after[2] for before, after in itertools.pairwise(steps))
    assert not any({"iteration", "seconds"} & numbers.keys() for _, numbers, _ in steps)


def test_a_key_that_yaml_reads_as_true_keeps_its_name(run):
    """`on` is a field of a measured force, and a word for `true` in YAML 1.1."""
    from cqrun.jobs.tracking.tracked import _flat
    from cqrun.scene.document import read

    assert dict(_flat(read("force: {on: body, column: F}").data)) == {"force.on": "body", "force.column": "F"}


def test_of_many_values_the_mean_and_the_range_are_given(run, tmp_path):
    copy = tmp_path / "beam" / run.name
    shutil.copytree(run, copy)
    result = result_of(copy)
    result["unknowns"][E_PATH]["value"] = [1.0e4 + k for k in range(MANY + 1)]
    (copy / "result.json").write_text(json.dumps(result))
    found = tracked(copy).found
    assert (found[f"{E_PATH}.least"], found[f"{E_PATH}.largest"]) == (1.0e4, 1.0e4 + MANY)
    assert found[f"{E_PATH}.mean"] == 1.0e4 + MANY / 2


def test_a_simulation_has_no_history(tmp_path):
    scene = tmp_path / "beam.yaml"
    scene.write_text(BEAM)
    what = tracked(run_simulate(scene, [], tmp_path / "out", threads=1))
    assert (what.history, list(what.steps())) == ({}, [])


def test_a_link_in_a_run_is_not_handed_on(run, tmp_path):
    copy = tmp_path / "beam" / run.name
    shutil.copytree(run, copy)
    (copy / "mine.csv").symlink_to(tmp_path / "secret")
    (tmp_path / "secret").write_text("secret")
    with pytest.raises(UsageError, match="is a link"):
        tracked(copy)


# --- refusals ---------------------------------------------------------------------------------------------------


def test_an_unfinished_run_is_refused(run, tmp_path):
    copy = tmp_path / "beam" / run.name
    shutil.copytree(run, copy)
    record = json.loads((copy / "run.json").read_text())
    changed(copy / "run.json", f'"status": "{record["status"]}"', '"status": "stopped"')
    with pytest.raises(UsageError, match=r"is not finished \(stopped\); the command that started it continues it"):
        export_to("tensorboard", copy, tmp_path / "out")
    with pytest.raises(UsageError, match="no run"):
        export_to("tensorboard", tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("tracker", TRACKERS)
def test_a_missing_package_is_named(run, tmp_path, monkeypatch, tracker):
    monkeypatch.setitem(sys.modules, TRACKERS[tracker].module, None)
    with pytest.raises(MissingExtra, match=rf"an export to {tracker} needs .*: pip install 'cqrun\[{tracker}\]'"):
        export_to(tracker, run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- what they read ---------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
def test_mlflow_reads_the_run(run, tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")  # nothing is sent there
    exported = export_to("mlflow", run, tmp_path / "all runs")
    assert (
        exported.show.endswith(f"mlflow ui --backend-store-uri '{exported.folder.as_uri()}'") or "%20" in exported.show
    )
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    client = mlflow.MlflowClient(tracking_uri=exported.folder.as_uri())
    experiment = client.get_experiment_by_name("beam")
    (made,) = client.search_runs([experiment.experiment_id])
    what = tracked(run)
    assert made.data.params == dict(what.parameters)
    assert made.data.tags[ID] == run.name
    assert made.data.tags["engine"] == what.tags["engine"]
    losses = [metric.value for metric in client.get_metric_history(made.info.run_id, "loss")]
    assert losses == list(what.history["loss"])
    assert made.data.metrics[f"found/{SHEAR_PATH}"] == what.found[SHEAR_PATH]
    assert {"result.json", "figures"} <= {file.path for file in client.list_artifacts(made.info.run_id)}
    assert made.info.status == "FINISHED"
    with pytest.raises(UsageError, match=r"has the run .* already"):
        export_to("mlflow", run, exported.folder)
    assert os.environ["MLFLOW_TRACKING_URI"] == "http://127.0.0.1:9"


@pytest.mark.filterwarnings("ignore")
def test_tensorboard_reads_the_run(run, tmp_path):
    pytest.importorskip("tensorboardX")
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c

    exported = export_to("tensorboard", run, tmp_path)
    (file,) = (tmp_path / "beam" / run.name).iterdir()
    data, events = file.read_bytes(), []
    while data:  # length, its checksum, the event, its checksum
        size = int.from_bytes(data[:8], "little")
        body = data[12 : 12 + size]
        assert masked_crc32c(body) == int.from_bytes(data[12 + size : 16 + size], "little")
        events.append(Event.FromString(body))
        data = data[16 + size :]
    values = [(event.step, value) for event in events for value in event.summary.value]
    losses = [value.simple_value for _, value in values if value.tag == "loss"]
    what = tracked(run)
    assert losses == pytest.approx(list(what.history["loss"]), rel=1e-6)
    tags = {value.tag for _, value in values}
    assert {f"found/{E_PATH}", "figures/convergence"} <= tags
    assert any("hparams" in tag for tag in tags)
    assert exported.show == f"tensorboard --logdir {tmp_path}"
    with pytest.raises(UsageError, match=r"has the run .* already"):
        export_to("tensorboard", run, tmp_path)


@pytest.mark.filterwarnings("ignore")
def test_wandb_writes_the_run_offline(run, tmp_path):
    pytest.importorskip("wandb")
    exported = export_to("wandb", run, tmp_path)
    (folder,) = (tmp_path / "wandb").glob("offline-run-*")
    assert exported.show == f"wandb sync {folder}"
    assert (folder / f"run-{run.name}.wandb").stat().st_size > 0
    assert (folder / "files" / "result.json").read_bytes() == (run / "result.json").read_bytes()
    assert (folder / "files" / "figures" / "convergence.png").is_file()

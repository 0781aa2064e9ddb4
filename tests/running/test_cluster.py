"""Runs on a Dask cluster: the same bits as those of processes, also if a worker dies or does not see our files."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from small_beam import Listener, assert_same, changed
from small_finger import STIFFNESS, written
from tiny_beam import BEAM, E

from cqrun.errors import MissingExtra, Stopped, UsageError
from cqrun.jobs.control import CODESIGN
from cqrun.jobs.studies.ablation import run_ablation
from cqrun.jobs.studies.seeds import run_seeds
from cqrun.jobs.studies.sweep import SweepOptions, run_sweep
from cqrun.running import cluster
from cqrun.running.fleet import Member
from cqrun.store.study import read_ablation, read_seeds, read_sweep

distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")

POINTS = SweepOptions([f"{E}=3e4:6e4:4"])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return the scene file."""
    path = tmp_path_factory.mktemp("scene") / "beam.yaml"
    path.write_text(BEAM)
    return path


@pytest.fixture(scope="module")
def expected(scene, tmp_path_factory):
    """Return the runs of processes, by their names."""
    path, good = run_sweep(scene, [], tmp_path_factory.mktemp("processes"), POINTS, threads=2)
    assert good
    return {Path(run.run).name: Path(run.run) for run in read_sweep(path).runs}


@pytest.fixture(scope="module")
def workers():
    """Return a scheduler with three workers on this machine, each a process of its own."""
    with distributed.LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None, memory_limit=0) as found:
        yield found


def on(workers):
    """Return the place of a cluster."""
    return workers.scheduler_address.replace("tcp://", "dask://")


def assert_as_expected(path, expected):
    """Fail unless a sweep's runs are those of processes, bit for bit."""
    runs = [Path(run.run) for run in read_sweep(path).runs]
    assert {run.name for run in runs} == set(expected)
    for run in runs:
        assert_same(run, expected[run.name])


def test_a_worker_that_dies_loses_nothing(scene, expected, workers, tmp_path):
    """The worker is killed while its run is half-way; another worker makes it."""
    killed = []

    def kill_one():
        with distributed.Client(workers) as client:
            for _ in range(400):
                busy = [w for w, keys in client.processing().items() if keys]
                if busy and list((tmp_path / "beam").glob("*/run.json")):
                    pid = client.run(os.getpid, workers=busy[:1])[busy[0]]
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)
                    return
                time.sleep(0.05)

    thread = threading.Thread(target=kill_one)
    thread.start()
    path, good = run_sweep(scene, [], tmp_path, replace(POINTS, on=on(workers)), threads=2)
    thread.join()
    assert killed
    assert good
    assert_as_expected(path, expected)
    assert not list(tmp_path.glob(".sweep-*"))


@pytest.mark.slow
def test_workers_without_our_files_send_the_runs_back(scene, expected, workers, tmp_path, monkeypatch):
    """They cannot read the token."""
    orders = []

    def hidden(*args):
        orders.append(order(*args))
        return replace(orders[-1], token="/nowhere")

    order = cluster._order
    monkeypatch.setattr(cluster, "_order", hidden)
    path, good = run_sweep(scene, [], tmp_path, replace(POINTS, on=on(workers)), threads=2)
    assert good
    assert len(orders) == 4
    assert_as_expected(path, expected)
    # a run that came back can be repeated here: its record names the scene's folder
    again, good = run_sweep(scene, [], tmp_path, POINTS, threads=2)
    assert (again, good) == (path, True)


@pytest.mark.slow
def test_seeds_and_variants_run_there_too(workers, tmp_path):
    """The variant with its design free has the runs of the seeds, which are there already."""
    scene = written(tmp_path)
    changed(scene, "max_iterations: 4", "max_iterations: 2")
    free = {"overrides": [f"unknowns={{{STIFFNESS}: {{bounds: [5, 20]}}}}"], "seeds": 2, "threads": 2}
    here, good = run_seeds(scene, out=tmp_path / "here", job=CODESIGN, **free)
    assert good
    there, good = run_seeds(scene, out=tmp_path / "there", job=CODESIGN, on=on(workers), **free)
    assert good
    seeds = read_seeds(there)
    for one, other in zip(seeds.seeds.values(), read_seeds(here).seeds.values(), strict=True):
        assert_same(Path(one.run), Path(other.run))
    listener = Listener()
    path, good = run_ablation(scene, out=tmp_path / "there", on=on(workers), reporter=listener, **free)
    assert good
    assert listener.said[-1].endswith("; 2 of 4 runs are there already")
    assert [v.runs for v in read_ablation(path).variants.values() if v.free] == [[s.run for s in seeds.seeds.values()]]


def test_a_scene_with_files_elsewhere_needs_a_shared_file_system():
    order = cluster.Order((), (), "", "", "", "/nowhere", "", "", cluster.engine_hash())
    assert "use a shared file system" in cluster.carry_out(order).message


def test_the_failure_of_a_run_elsewhere_names_the_run_here(tmp_path, monkeypatch):
    """The folder on the worker is gone by then."""
    member, scene = Member("seed 0", tmp_path / "beam" / "0123", [], 1), tmp_path / "beam.yaml"

    def failing(order, source, out):
        run = Path(out) / "beam" / "0123"
        return cluster.Outcome(75, f"error: {run}: it stopped; `cqrun resume {run}` continues")

    monkeypatch.setattr(cluster, "_process", failing)
    where = (str(scene), str(tmp_path), str(member.run), "/nowhere", "", "", cluster.engine_hash())
    outcome = cluster.carry_out(cluster.Order((), (), *where, cluster.Parcel("beam.yaml", {})))
    cluster._take(cluster._Task(member, SimpleNamespace(status="finished", result=lambda: outcome)), scene)
    assert member.failure == f"it stopped; `cqrun resume {member.run}` continues"


def test_a_worker_with_another_engine_makes_no_run():
    order = cluster.Order((), (), "", "", "", "/nowhere", "", "", "0" * 12)
    assert "a worker has another engine" in cluster.carry_out(order).message


@pytest.mark.slow
def test_a_stopped_sweep_stops_its_runs(scene, workers, tmp_path):
    options = SweepOptions([f"{E}=3e4:6e4:8"], on=on(workers))
    with pytest.raises(Stopped, match="of 8 runs are finished"):
        run_sweep(scene, ["time.duration=20"], tmp_path, options, reporter=Listener(stop_after=20))
    with distributed.Client(workers) as client:
        assert not any(client.processing().values())


def test_places_that_are_none(scene, tmp_path):
    with pytest.raises(UsageError, match="--on moon: no such place; there are processes, dask, "):
        run_sweep(scene, [], tmp_path, replace(POINTS, on="moon"))
    with pytest.raises(UsageError, match=r"--on dask://127\.0\.0\.1:1: no scheduler answers"):
        run_sweep(scene, [], tmp_path, replace(POINTS, on="dask://127.0.0.1:1"))


def test_without_dask_its_extra_is_named(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"needs distributed.*pip install 'cqrun\[dask\]'"):
        run_sweep(scene, [], tmp_path, replace(POINTS, on="dask"))

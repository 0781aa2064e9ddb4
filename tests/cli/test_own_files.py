"""Every file that cqrun writes into a run is one that it knows as its own, and no command writes through a link."""

from __future__ import annotations

import shutil

import pytest
from small_beam import BEAM, FIT, recorded
from small_finger import DESIGN, written

from cqrun.errors import UsageError
from cqrun.jobs.control import run_codesign
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.studies.seeds import run_seeds
from cqrun.jobs.sysid import run_sysid
from cqrun.store.folder import clear

TWO = "optimizer={adam: {max_iterations: 2}}"


MEASURE = "measure={tip: {position: {}}}"


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Return a run of sysid that has made its data."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "fit.yaml").write_text(BEAM + FIT)
    return run_sysid(folder / "fit.yaml", [TWO], folder / "out", threads=1)


@pytest.fixture(scope="module")
def runs(fitted, tmp_path_factory):
    """Return runs of every job by name, and a replay of each that can be replayed."""
    folder = tmp_path_factory.mktemp("jobs")
    out, data = folder / "out", sorted((fitted / "synthetic").glob("*.csv"))
    recording = recorded(folder / "recorded.yaml", {"swing": data[0]})
    design = written(folder, DESIGN)
    designed = run_codesign(design, ["optimizer.slsqp.max_iterations=2", "constraints={}"], out, threads=1)
    return {
        "sysid of its own data": fitted,
        "sysid of a recording": run_sysid(recording, [TWO], out, threads=1),
        "simulate": run_simulate(fitted.parents[2] / "fit.yaml", ["unknowns={}", "data=null", MEASURE], out, threads=1),
        "replay of sysid": run_simulate(fitted, [], out, threads=1),
        "gradcheck": run_gradcheck(fitted.parents[2] / "fit.yaml", [], out, threads=1)[0],
        "codesign": designed,
        "replay of codesign": run_simulate(designed, [], out, threads=1),
    }


def test_every_file_of_a_run_is_known_as_cqruns_own(cqrun, runs, tmp_path):
    for name, run in runs.items():
        copy = tmp_path / run.name
        shutil.copytree(run, copy)
        drawn = name != "gradcheck"
        for words in (["plot", copy], ["plot", copy, "--show", "loss"]) if drawn and "re" not in name[:3] else ():
            cqrun(*words)
        for kind in ("--gif", "--png", "--stills=2", "--onion=2") if drawn else ():
            assert cqrun("render", copy, kind, "-q", "--every", "5")[0] == 0, name
        if name == "codesign":
            assert cqrun("export", copy, "--design", "-q")[0] == 0
        clear(copy)
        assert [file.name for file in copy.rglob("*")] == ["lock"], name


def test_no_command_writes_through_a_link(cqrun, fitted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    victim, run = tmp_path / "mine", tmp_path / "results" / "fit" / fitted.name
    victim.mkdir()
    (victim / "notes.txt").write_text("precious")
    shutil.copytree(fitted, run)
    shutil.rmtree(run / "figures", ignore_errors=True)
    (run / "figures").symlink_to(victim)
    (tmp_path / "results" / "figures").symlink_to(victim)
    whole = tmp_path / "whole"
    shutil.copytree(fitted, whole)
    for words in (
        ["plot", run],
        ["render", run],
        ["export", run, "--design"],
        ["resume", run],
        ["simulate", run],
        ["sysid", fitted.parents[2] / "fit.yaml", "-o", TWO, "--out", "results"],
        ["plot", whole, fitted],
    ):
        code, _, err = cqrun(*words)
        assert code == 2, words
        assert f"figures: is a link to {victim}, and cqrun follows no links in its results" in err
    assert [file.name for file in victim.iterdir()] == ["notes.txt"]


def test_a_study_writes_its_summary_through_no_link(tmp_path):
    scene, victim = written(tmp_path), tmp_path / "mine"
    victim.mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / scene.stem).symlink_to(victim)
    with pytest.raises(UsageError, match="is a link to"):
        run_seeds(scene, [], tmp_path / "out", seeds=2, threads=1)
    assert not list(victim.iterdir())

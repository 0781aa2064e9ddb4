"""The folder of a run: no link in it is followed, and only files of cqrun are deleted."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cqrun.disk import open_file, replacing
from cqrun.errors import CqrunError, UsageError
from cqrun.store.folder import OWN_FILES, OWN_FOLDERS, _delete, make_below
from cqrun.store.frames import Frames
from cqrun.store.lock import is_locked
from cqrun.store.run import RunDirectory, read_record
from cqrun.store.run_scene import RunScene

NAMES = sorted({name.replace("[01]", "0") for name in OWN_FILES} | {"force.csv", ".run.json.4711.tmp"})
INSIDE = [f"{folder}/{patterns[0].replace('*', 'a')}" for folder, patterns in OWN_FOLDERS.items()]
SCENE = RunScene("beam", "cqrun: 1\n", "cqrun: 1\n", tables=("force.csv",))


def begin(out: Path, *, fresh: bool = False) -> RunDirectory:
    return RunDirectory.open(SCENE, out, argv=["cqrun"], seed=0, threads=1, fresh=fresh)


@pytest.fixture
def victim(tmp_path):
    """Return a folder of the user's own."""
    folder = tmp_path / "mine"
    (folder / "deeper").mkdir(parents=True)
    (folder / "notes.txt").write_text("precious")
    (folder / "deeper" / "figures.png").write_text("precious")
    return folder


@pytest.fixture
def run(tmp_path):
    """Return the folder of a run that was begun and stopped."""
    with begin(tmp_path / "out") as opened:
        opened.begin()
        opened.log("sampling")
    return opened.path


def contents(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def every_way_in(run: Path):
    """Return the ways in which a run is opened."""
    out = run.parents[1]
    return {
        "the same command": lambda: begin(out),
        "--fresh": lambda: begin(out, fresh=True),
        "resume": lambda: RunDirectory.resume(run),
        "plot": lambda: read_record(run),
    }


@pytest.mark.parametrize("way", ["the same command", "--fresh", "resume", "plot"])
@pytest.mark.parametrize("place", ["run", *NAMES, *OWN_FOLDERS, *INSIDE])
def test_a_link_in_place_of_a_run_or_of_anything_in_it_is_refused(tmp_path, victim, run, place, way):
    before = contents(victim)
    at, target = (run if place == "run" else run / place), victim
    if place == "run":
        run.rename(tmp_path / "elsewhere")
        (tmp_path / "elsewhere" / "run.json").rename(victim / "run.json")
        before = contents(victim)
    elif place not in OWN_FOLDERS:
        target = victim / "notes.txt"
    at.parent.mkdir(exist_ok=True)
    at.unlink(missing_ok=True)
    at.symlink_to(target)
    with pytest.raises(UsageError, match=rf"{at.name}: is a link to .*{target.name}, and cqrun follows no links"):
        every_way_in(run)[way]()
    assert contents(victim) == before
    assert at.is_symlink()


def test_a_link_in_place_of_a_scenes_folder_is_refused(tmp_path, victim):
    before = contents(victim)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "beam").symlink_to(victim)
    with pytest.raises(UsageError, match=r"out/beam: is a link to "):
        begin(tmp_path / "out")
    assert contents(victim) == before
    assert not list(victim.glob("*/lock"))


def test_the_folder_of_all_results_may_be_a_link(tmp_path, victim):
    (tmp_path / "out").symlink_to(victim)
    with begin(tmp_path / "out") as opened:
        assert (victim / "beam" / opened.path.name / "run.json").is_file()


@pytest.mark.parametrize("name", ["", ".", ".."])
def test_no_folder_of_results_lies_outside_them(tmp_path, name):
    (tmp_path / "out").mkdir()
    with pytest.raises(UsageError, match="give the scene's file another name"):
        make_below(tmp_path / "out", name, "0123456789ab")
    assert [p.name for p in tmp_path.rglob("*")] == ["out"]


@pytest.mark.parametrize("way", ["the same command", "--fresh", "resume", "plot"])
@pytest.mark.parametrize("place", ["log.txt", "lock", "figures/bodies.png"])
def test_a_pipe_in_place_of_a_file_is_refused_and_not_waited_for(run, place, way):
    (run / place).parent.mkdir(exist_ok=True)
    (run / place).unlink(missing_ok=True)
    os.mkfifo(run / place)
    with pytest.raises(UsageError, match=r"is not an ordinary file"):
        every_way_in(run)[way]()


@pytest.mark.parametrize("name", ["lock", "log.txt", "history.csv", "evals.log"])
def test_a_file_with_a_second_name_is_not_written(tmp_path, victim, name):
    """As a hard link in an archive would make it."""
    run = begin(tmp_path / "out")
    (run.path / name).unlink(missing_ok=True)
    (run.path / name).hardlink_to(victim / "notes.txt")
    with pytest.raises(UsageError, match=rf"{name}: is the same file as another \(a hard link\)"):
        {"lock": lambda: begin(tmp_path / "out"), "log.txt": lambda: run.log("x")}.get(
            name, lambda: (run.history(["loss"]), run.replay_log())
        )()
    run.close()
    assert (victim / "notes.txt").read_text() == "precious"


@pytest.mark.parametrize(
    "mode", [{"mode": "rb"}, {"mode": "w", "encoding": "utf-8"}, {"mode": "ab"}, {"mode": "r+b", "buffering": 0}]
)
def test_a_file_is_not_opened_through_a_link_even_where_nobody_has_looked(tmp_path, victim, mode):
    (tmp_path / "log.txt").symlink_to(victim / "notes.txt")
    with pytest.raises(UsageError, match=r"log.txt: is a link"):
        open_file(tmp_path / "log.txt", **mode)
    (tmp_path / "new.txt").symlink_to(victim / "new.txt")
    with pytest.raises(UsageError, match=r"new.txt: is a link"):
        open_file(tmp_path / "new.txt", **mode)
    assert sorted(contents(victim)) == ["deeper/figures.png", "notes.txt"]
    assert (victim / "notes.txt").read_text() == "precious"


def test_a_planted_temporary_name_is_replaced_and_not_written_through(tmp_path, victim):
    (tmp_path / f".a.json.{os.getpid()}.tmp").symlink_to(victim / "notes.txt")
    with replacing(tmp_path / "a.json") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a.json").read_text() == "new"
    assert (victim / "notes.txt").read_text() == "precious"
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_lock_behind_a_link_is_not_asked(tmp_path, victim):
    (tmp_path / "lock").symlink_to(victim / "notes.txt")
    assert not is_locked(tmp_path)


def test_fresh_deletes_the_files_of_a_run_and_only_these(tmp_path, run):
    for name in [*NAMES, *INSIDE]:
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).touch()
    (run / "figures" / ".DS_Store").touch()
    (run / ".nfs0001").touch()
    with begin(tmp_path / "out", fresh=True):
        left = {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}
    assert left == {"lock", "run.json", "scene.yaml", "scene.original.yaml", "figures/.DS_Store", ".nfs0001"}


@pytest.mark.parametrize("name", ["notes.txt", "other.csv", "notes/a.txt", "figures/photo.png", "plugins/data.csv"])
@pytest.mark.parametrize("record", [True, False])
def test_what_cqrun_did_not_write_is_neither_deleted_nor_overwritten(tmp_path, run, name, record):
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).write_text("mine")
    if not record:
        (run / "run.json").unlink()
    before = contents(run)
    foreign = "notes" if name.startswith("notes/") else name
    with pytest.raises(UsageError, match=rf"holds {foreign}, which cqrun did not write; nothing was deleted"):
        begin(tmp_path / "out", fresh=record)
    assert contents(run) == before
    if record:
        with begin(tmp_path / "out"):  # to go on with the run nothing has to be deleted
            pass


def test_temporary_files_in_the_folders_of_a_run_are_removed_after_a_kill(run):
    (run / "figures").mkdir()
    (run / "figures" / ".bodies.png.4711.tmp").touch()
    with RunDirectory.resume(run):
        assert not list(run.rglob("*.tmp"))


def test_a_trajectory_is_not_read_through_a_link(tmp_path, victim):
    (tmp_path / "trajectory.h5").symlink_to(victim / "notes.txt")
    with pytest.raises(CqrunError, match=r"trajectory.h5: is a link"):
        Frames(tmp_path / "trajectory.h5")


def test_files_behind_a_folder_that_became_a_link_are_not_deleted(tmp_path: Path) -> None:
    """The link may appear between the check and the deletion."""
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "log.txt").write_text("precious")
    (tmp_path / "run").symlink_to(tmp_path / "other")
    with pytest.raises(OSError, match="run"):
        _delete(tmp_path / "run", ["*"])
    assert (tmp_path / "other" / "log.txt").read_text() == "precious"

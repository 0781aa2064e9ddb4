"""Files of a run that were cut, emptied, flipped or removed: each is refused by name, or the intact part is used."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from small_beam import BEAM, FIT, Listener, assert_same

from cqrun.errors import CqrunError, Stopped, UsageError
from cqrun.figures.run_data import read_run
from cqrun.jobs.resume import run_resume
from cqrun.jobs.sysid import run_sysid
from cqrun.store.frames import Frames
from cqrun.store.history import CHECK, History, read_history
from cqrun.store.run import read_record

ADAM = "optimizer={adam: {max_iterations: 6}}"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a finished fit, whose optimizer saves its states."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "fit.yaml").write_text(BEAM + FIT)
    return run_sysid(folder / "fit.yaml", [ADAM], folder / "out", threads=1)


@pytest.fixture(scope="module")
def half(whole, tmp_path_factory):
    """Return the same fit, stopped in the middle."""
    out = tmp_path_factory.mktemp("half")
    with pytest.raises(Stopped):
        run_sysid(whole.parents[2] / "fit.yaml", [ADAM], out, threads=1, reporter=Listener(stop_after=3))
    return next(out.glob("fit/*"))


@pytest.fixture
def stopped(half, tmp_path):
    return shutil.copytree(half, tmp_path / "fit" / half.name)


def damaged(content: bytes, how: str, rng: np.random.Generator) -> bytes | None:
    """Return what is left of a file, or None if nothing is."""
    if how == "flipped":
        at = int(rng.integers(len(content)))
        return content[:at] + bytes([content[at] ^ (1 << int(rng.integers(8)))]) + content[at + 1 :]
    return {"missing": None, "empty": b"", "cut": content[: int(rng.integers(1, len(content)))]}[how]


def refusal(action) -> str | None:
    """Return the message with which an action is refused, or None."""
    try:
        action()
    except CqrunError as error:
        return str(error)
    return None


@pytest.mark.parametrize("how", ["missing", "empty", "cut", "flipped"])
@pytest.mark.parametrize(
    "name",
    ["run.json", "scene.yaml", "history.csv", "evals.0.npz", "evals.1.npz", "synthetic/synthetic_0.csv", "result.json"],
)
@pytest.mark.parametrize("seed", range(3))
def test_a_damaged_run_goes_on_to_the_same_result_or_says_which_file_is_damaged(stopped, whole, name, how, seed):
    file = stopped / name
    content = damaged(file.read_bytes(), how, np.random.default_rng(seed))
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    refused = refusal(lambda: run_resume(stopped, [], threads=1))
    if refused is None:
        assert_same(stopped, whole)
    else:
        assert name.rpartition("/")[2].split(".")[0] in refused


def test_a_flipped_number_in_a_row_of_the_history_is_seen(stopped, whole):
    """A digit of the loss in a row that the optimizer does not compute again."""
    rows = (stopped / "history.csv").read_bytes().split(b"\n")
    before = rows[1]
    rows[1] = before.replace(before.split(b",")[1], b"1" + before.split(b",")[1], 1)
    (stopped / "history.csv").write_bytes(b"\n".join(rows))
    for read in (lambda: run_resume(stopped, [], threads=1), lambda: read_run(stopped)):
        with pytest.raises(UsageError, match=r"history\.csv:2: this row is damaged, and others follow it"):
            read()


def test_a_flipped_last_row_is_computed_again_from_the_checkpoint_before_it(stopped, whole):
    file = stopped / "history.csv"
    file.write_bytes(file.read_bytes()[:-3] + b"x\n")
    run_resume(stopped, [], threads=1)
    assert_same(stopped, whole)
    assert "history.csv lacks the last rows" in (stopped / "log.txt").read_text()


def test_lost_checkpoints_are_not_taken_for_a_new_run(stopped):
    for k in (0, 1):
        (stopped / f"evals.{k}.npz").unlink()
    before = (stopped / "history.csv").read_bytes()
    with pytest.raises(UsageError, match=r"evals\.0\.npz and evals\.1\.npz are missing, and history\.csv has \d rows"):
        run_resume(stopped, [], threads=1)
    assert (stopped / "history.csv").read_bytes() == before


def test_lost_rows_are_not_taken_for_a_new_run(stopped):
    (stopped / "history.csv").unlink()
    with pytest.raises(UsageError, match=r"evals\.0\.npz: the checkpoint is of iteration \d, and history\.csv has 0"):
        run_resume(stopped, [], threads=1)


def test_a_run_without_checksums_goes_on(stopped, whole):
    """As one of an earlier version."""
    rows = [row.rpartition(",")[0] for row in (stopped / "history.csv").read_text().splitlines()]
    assert rows[0].endswith(",seconds")
    (stopped / "history.csv").write_text("\n".join(rows) + "\n")
    record = json.loads((stopped / "run.json").read_text())
    del record["scenes"]
    (stopped / "run.json").write_text(json.dumps(record))
    run_resume(stopped, [], threads=1)
    mine, theirs = read_history(stopped / "history.csv"), read_history(whole / "history.csv")
    assert {k: v for k, v in mine.items() if k != "seconds"} == {k: v for k, v in theirs.items() if k != "seconds"}
    assert CHECK not in (stopped / "history.csv").read_text()


def test_a_scene_that_has_changed_is_not_drawn_or_replayed(stopped):
    file = stopped / "scene.yaml"
    file.write_text(file.read_text().replace("density: 1000", "density: 1001"))
    with pytest.raises(UsageError, match=r"scene\.yaml: has changed since the run began"):
        read_run(stopped)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"status": "conuerged"}, "status: is 'conuerged', which is none of a run"),
        ({"seconds": "3"}, "seconds: is '3'"),
        ({"files": {"a.csv": "0123"}}, "files: the hash of 'a.csv' is '0123'"),
        ({"job": None}, "job: is empty"),
    ],
)
def test_a_wrong_entry_of_the_record_is_named(stopped, change, message):
    record = json.loads((stopped / "run.json").read_text()) | change
    (stopped / "run.json").write_text(json.dumps(record))
    with pytest.raises(UsageError) as refused:
        read_record(stopped)
    assert f"run.json: unreadable ({message})" in str(refused.value)


def test_every_flipped_bit_of_a_row_is_seen(tmp_path):
    history = History(tmp_path / "h.csv", ["loss"])
    for k in range(3):
        history.record(k, {"loss": 1.0 / (k + 3)}, seconds=0.5 * k)
    history.close()
    content = (tmp_path / "h.csv").read_bytes()
    expected, begin = read_history(tmp_path / "h.csv"), content.index(b"\n") + 1
    for bit in range(8 * begin, 8 * len(content)):
        spoilt = bytearray(content)
        spoilt[bit // 8] ^= 1 << bit % 8
        (tmp_path / "h.csv").write_bytes(spoilt)
        found = {}
        refused = refusal(lambda found=found: found.update(read_history(tmp_path / "h.csv")))
        if refused is None:
            rows = len(found["loss"])
            assert rows < 3
            assert found == {name: column[:rows] for name, column in expected.items()}
        else:
            assert "h.csv" in refused


@pytest.mark.parametrize("how", ["empty", "cut", "flipped"])
def test_a_damaged_trajectory_is_refused_by_name_or_read_as_it_was(whole, tmp_path, rng, how):
    content = (whole / "trajectory.h5").read_bytes()
    with Frames(whole / "trajectory.h5") as frames:
        names, expected = frames.fields, {name: frames.read_all(name) for name in frames.fields}
    for _ in range(40):
        (tmp_path / "trajectory.h5").write_bytes(damaged(content, how, rng) or b"")
        found = {}

        def read(found=found):
            with Frames(tmp_path / "trajectory.h5") as frames:
                found |= {name: frames.read_all(name) for name in names}

        refused = refusal(read)
        assert refused is None or "trajectory.h5" in refused
        for name in names if refused is None else ():
            np.testing.assert_array_equal(found[name], expected[name])


def test_a_trajectory_whose_numbers_are_in_another_file_is_refused(whole, tmp_path):
    import h5py

    shutil.copy(whole / "trajectory.h5", tmp_path / "trajectory.h5")
    shutil.copy(whole / "trajectory.h5", tmp_path / "other.h5")
    with h5py.File(tmp_path / "trajectory.h5", "r+") as file:
        del file["particles/x"]
        file["particles/x"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "particles/x")
    with pytest.raises(UsageError, match="'x' is a link, perhaps to another file"):
        Frames(tmp_path / "trajectory.h5")

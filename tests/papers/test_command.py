"""`make reproduce-figures`: the command, stopped, killed or interrupted by errors."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from toys import COUNT, Toy

from benchmarks.papers import __main__ as command
from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.families.learners import NOT_TRAINED
from benchmarks.papers.figure import Size
from benchmarks.papers.machinery import rebuild
from benchmarks.papers.machinery.process import ROOT, STOPPED
from benchmarks.papers.machinery.publish import Publication
from benchmarks.papers.machinery.task import DONE, TaskError

PUBLISHED = ROOT / "results" / "figures"


def test_the_list_names_every_figure(capsys):
    assert command.main(["--list"]) == 0
    output = capsys.readouterr().out
    assert all(figure.id in output and figure.title in output for figure in FIGURES.values())


def test_a_reader_of_the_list_may_stop_reading():
    words = [sys.executable, "-u", "-m", "benchmarks.papers", "--list"]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline().startswith("cq1_table2")
        child.stdout.close()
        assert child.stderr.read() == ""


def test_figures_may_be_named_in_one_option_or_in_several(capsys):
    assert command.main(["--list", "--only", "cq2_fig11", "cq2_fig12", "--only", "cq2_fig13"]) == 0
    output = capsys.readouterr().out
    assert {name for name in FIGURES if name in output} == {"cq2_fig11", "cq2_fig12", "cq2_fig13"}


def test_no_time_is_no_work(tmp_path, capsys):
    words = ["--only", "cq2_fracture", "--minutes", "0", "--runs", str(tmp_path / "r"), "--out", str(tmp_path / "o")]
    assert command.main(words) == 75
    assert "not everything is done: the same command continues" in capsys.readouterr().out


def test_a_place_that_is_none_is_refused(tmp_path, capsys):
    assert command.main(["--on", "moon", "--runs", str(tmp_path / "r"), "--out", str(tmp_path / "o")]) == 2
    assert "--on moon: no such place; there are processes, dask, " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_folder_for_runs_that_cannot_be_made_is_reported_with_its_option(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert command.main(["--only", "cq2_fracture", "--runs", str(tmp_path / "file"), "--out", str(tmp_path / "o")]) == 2
    assert "choose another place with --runs" in capsys.readouterr().err


@pytest.fixture
def two_figures(tmp_path, monkeypatch):
    """The command has two figures, each of which counts to three; and the words that run both."""
    toys = {}
    for name in ("one", "two"):
        toy = Toy(replace(COUNT, name=name, typed=f"count {name}"))
        toy.id = name
        toys[name] = toy
    monkeypatch.setattr(command, "FIGURES", toys)
    monkeypatch.setattr(command, "write_page", lambda *_: [])
    return toys, ["--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]


def test_an_error_in_a_task_does_not_stop_other_figures(two_figures, capsys):
    toys, words = two_figures

    def broken(folder, deadline):
        raise TaskError("it does not count")

    toys["one"].all_tasks = (replace(toys["one"].all_tasks[0], measure=broken),)
    assert [command.main(words) for _ in range(3)] == [1, 1, 1]
    output = capsys.readouterr().out
    assert "error: one: it does not count" in output
    assert "quick: reproduced: they grow (yes)" in output


def test_a_fault_in_a_figure_does_not_stop_the_others(two_figures, capsys):
    toys, words = two_figures
    toys["one"].table = lambda folders, size: 1 / 0
    assert [command.main(words) for _ in range(4)][-1] == 1
    output = capsys.readouterr().out
    assert f"error: one: ZeroDivisionError: division by zero ({__file__}:" in output
    assert "quick: reproduced: they grow (yes)" in output


def test_what_another_engine_has_begun_is_not_touched(two_figures, tmp_path, capsys, monkeypatch):
    """Such a task was once started over, and reported only in the end."""
    _, words = two_figures

    def refused(task, runs, archive):
        if task.name == "one":
            raise TaskError("600 minutes of work by another engine")

    monkeypatch.setattr(rebuild, "unpack", refused)
    assert [command.main(words) for _ in range(3)] == [1, 1, 1]
    assert "    error: one: 600 minutes of work by another engine" in capsys.readouterr().out
    assert not (tmp_path / "runs" / "quick" / "one").exists()
    assert (tmp_path / "out" / "quick" / "two.png").exists()


def test_a_part_does_not_replace_the_whole(two_figures, tmp_path, capsys):
    """A fresh clone has the figures that are committed, and none of their runs."""
    toys, words = two_figures
    assert [command.main(words) for _ in range(3)] == [75, 75, 0]
    files = sorted((tmp_path / "out" / "quick").glob("*.*"))
    before = [file.read_bytes() for file in files]
    shutil.rmtree(tmp_path / "runs")
    assert command.main(words) == 75
    assert "the published figure is complete, and stays" in capsys.readouterr().out
    assert [file.read_bytes() for file in files] == before
    for toy in toys.values():  # a scene has changed: what was published stays until all tasks are done again
        toy.all_tasks = tuple(replace(task, typed=f"{task.typed} again") for task in toy.all_tasks)
    assert command.main(words) == 75
    assert "it stays until the new ones are done" in capsys.readouterr().out
    assert [file.read_bytes() for file in files] == before
    assert list((tmp_path / "out" / "quick" / "unfinished").glob("*.tar.xz"))
    assert [command.main(words) for _ in range(2)] == [75, 0]
    record = json.loads((tmp_path / "out" / "quick" / "one.json").read_text())
    assert all(task["command"].endswith("again") for task in record["works"].values())


def test_a_small_part_does_not_replace_a_larger_one(two_figures, tmp_path, capsys):
    """Twenty seconds of a paper-size figure once replaced an hour of it."""
    toys, words = two_figures
    assert command.main([*words, "--only", "one"]) == 75
    record = tmp_path / "out" / "quick" / "one.json"
    published = json.loads(record.read_text())
    published["works"]["one"]["minutes"] = 50.0
    record.write_text(json.dumps(published))
    for again in ("", " differently"):  # the same task from the start, and another one
        toys["one"].all_tasks = (replace(toys["one"].all_tasks[0], typed=f"count one{again}"),)
        shutil.rmtree(tmp_path / "runs")
        assert command.main([*words, "--only", "one"]) == 75
        assert (
            "has 0 of 1 tasks done in 50 min: it stays until there is more; here 0 are done in under a second"
            in capsys.readouterr().out
        )
        assert json.loads(record.read_text()) == published
    assert [command.main([*words, "--only", "one"]) for _ in range(2)] == [75, 0]  # the whole is more than any part
    assert json.loads(record.read_text())["done"] == [1, 1]


@pytest.mark.parametrize("file", ["runs/quick/one/clock.json", "out/quick/one.json", "out/quick/unfinished/one.tar.xz"])
def test_a_damaged_file_stops_only_its_figure(two_figures, tmp_path, capsys, file):
    _, words = two_figures
    assert command.main(words) == 75
    if "unfinished" in file:
        shutil.rmtree(tmp_path / "runs" / "quick" / "one")
    (tmp_path / file).write_bytes(b"")
    later = 0 if file.endswith("one.json") else 1  # a published figure is made again; a task is for its owner
    assert [command.main(words) for _ in range(3)] == [1, later, later]
    output = capsys.readouterr().out
    assert (tmp_path / file).name in output
    assert "quick: reproduced: they grow (yes)" in output
    assert (tmp_path / "out" / "quick" / "two.png").exists()


@pytest.mark.slow
def test_damaged_published_files_are_reported_on_the_page(tmp_path, capsys):
    shutil.copytree(PUBLISHED, tmp_path / "figures")
    (tmp_path / "figures" / "quick" / "cq2_fig5.json").write_text("<<<<<<< ours")
    (tmp_path / "figures" / "quick" / "cq2_fig6.png").unlink()
    (tmp_path / "figures" / "quick" / "cq2_fig7.csv").write_text("variant\n")
    assert command.main(["--page", "--out", str(tmp_path / "figures")]) == 1
    output, page = capsys.readouterr().out, (tmp_path / "figures" / "index.html").read_text()
    for name in ("cq2_fig5.json: damaged", "cq2_fig6.png: missing", "cq2_fig7.csv: not the numbers"):
        assert name in output
        assert name in page
    assert "3 damaged" in page
    words = ["--only", "cq2_fig7", "cq2_fracture", "--out", str(tmp_path / "figures")]
    assert command.main(["--judge", *words]) == 1  # the others are judged
    output = capsys.readouterr().out
    assert "cq2_fig7, quick: error: " in output
    assert "cq2_fracture, quick: reproduced" in output
    assert command.main(["--minutes", "0", "--unpublished", "--runs", str(tmp_path / "runs"), *words]) == 75
    assert "1 figures, size quick" in capsys.readouterr().out  # a damaged figure counts as not published
    record = tmp_path / "figures" / "quick" / "cq2_fig8.json"
    record.write_text("{}")
    assert command.main(["--page", "--out", str(tmp_path / "figures")]) == 1
    assert "cq2_fig8.json: damaged: done: Field required" in (tmp_path / "figures" / "README.md").read_text()


def test_complete_figures_may_be_skipped(two_figures, tmp_path, capsys):
    """A fresh clone continues with what nobody has done yet; without the option it repeats everything."""
    toys, words = two_figures
    assert [command.main([*words, "--only", "one"]) for _ in range(3)] == [75, 75, 0]
    shutil.rmtree(tmp_path / "runs")
    assert [command.main([*words, "--unpublished"]) for _ in range(3)] == [75, 75, 0]
    assert "1 figures, size quick" in capsys.readouterr().out
    assert not (tmp_path / "runs" / "quick" / "one").exists()
    assert (tmp_path / "out" / "quick" / "two.png").exists()
    toys["one"].all_tasks = (
        replace(toys["one"].all_tasks[0], typed="count one again"),
    )  # the published task was another one
    assert command.main([*words, "--unpublished"]) == 75


def test_a_task_that_figures_share_is_counted_once(two_figures, capsys):
    toys, words = two_figures
    toys["two"].all_tasks = toys["one"].all_tasks
    command.main([*words, "--minutes", "0"])
    output = capsys.readouterr().out
    assert "2 figures, size quick: about 60 s of work left" in output


def test_a_figure_of_which_nothing_can_be_shown_is_reported_and_packed(tmp_path, monkeypatch, capsys):
    figure, packed = FIGURES["cq2_fracture"], []
    tasks = figure.tasks(Size.QUICK)
    for task in tasks:
        folder = tmp_path / "r" / "quick" / task.name
        folder.mkdir(parents=True)
        (folder / DONE).write_text(json.dumps({"fingerprint": task.fingerprint(), "seeds": 0, "engine": "-"}))
    monkeypatch.setattr(Publication, "publish", lambda *_: None)
    monkeypatch.setattr(rebuild, "pack", lambda task, *_: packed.append(task.name))
    rebuild.publish_progress(Publication(figure, Size.QUICK, tmp_path / "o"), tmp_path / "r" / "quick")
    assert "there is nothing to show" in capsys.readouterr().out
    assert len(packed) == len(tasks)


def test_committed_curves_of_ppo_are_shown_only_for_their_own_task(tmp_path, monkeypatch):
    finger = FIGURES["cq1_fig7_fixed"]
    monkeypatch.setattr("benchmarks.papers.families.learners.importlib.util.find_spec", lambda name: None)
    *_, ppo = finger.tasks(Size.QUICK)
    assert ppo.do(tmp_path / "a", 1.0, 1)
    assert ppo.remark(tmp_path / "a") == NOT_TRAINED
    monkeypatch.setattr(type(finger), "squared", "")
    *_, other = finger.tasks(Size.QUICK)
    with pytest.raises(TaskError, match="PPO cannot be trained: stable_baselines3 is not installed"):
        other.do(tmp_path / "b", 1.0, 1)


def words_for_fracture(folder):
    words = [sys.executable, "-m", "benchmarks.papers", "--only", "cq2_fracture"]
    return [*words, "--runs", str(folder / "runs"), "--out", str(folder / "out")]


@pytest.mark.slow
def test_a_killed_command_continues(tmp_path):
    """SIGKILL while the second of two tasks runs: the first is kept, and the same command finishes."""
    words, pipes = words_for_fracture(tmp_path), {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(words, cwd=ROOT, start_new_session=True, **pipes)
    first, deadline = tmp_path / "runs" / "quick" / "tear_1" / DONE, time.monotonic() + 120.0
    while not first.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    stamp = first.stat().st_mtime_ns
    assert not (tmp_path / "out" / "quick" / "cq2_fracture.png").exists()
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    assert first.stat().st_mtime_ns == stamp
    assert "reproduced" in done.stdout
    assert (tmp_path / "out" / "index.html").exists()


def test_a_command_that_is_asked_to_stop_stops_its_runs(tmp_path):
    words = words_for_fracture(tmp_path)
    child = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 120.0
    while not list((tmp_path / "runs").rglob("run.json")) and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGTERM)
    output, _ = child.communicate(timeout=300.0)
    assert output.endswith("stopped: the same command continues\n")
    assert child.returncode == STOPPED
    records = [json.loads(file.read_text()) for file in (tmp_path / "runs").rglob("run.json")]
    assert records
    assert "running" not in {record["status"] for record in records}

"""`make reproduce-figures`: the command, killed or not, and the page."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from toys import COUNT, Toy

from benchmarks.papers import __main__ as command
from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.families.learners import COMMITTED
from benchmarks.papers.figure import Size
from benchmarks.papers.machinery import rebuild
from benchmarks.papers.machinery.page import _remarks, write_page
from benchmarks.papers.machinery.process import ROOT
from benchmarks.papers.machinery.work import WorkError

PUBLISHED = ROOT / "results" / "figures"


def test_the_list_names_every_figure(capsys):
    assert command.main(["--list"]) == 0
    told = capsys.readouterr().out
    assert all(figure.id in told and figure.title in told for figure in FIGURES.values())


def test_a_reader_of_the_list_may_stop_reading():
    words = [sys.executable, "-u", "-m", "benchmarks.papers", "--list"]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline().startswith("cq1_table2")
        child.stdout.close()
        assert child.stderr.read() == ""


def test_figures_may_be_named_in_one_option_or_in_several(capsys):
    assert command.main(["--list", "--only", "cq2_fig11", "cq2_fig12", "--only", "cq2_fig13"]) == 0
    told = capsys.readouterr().out
    assert {name for name in FIGURES if name in told} == {"cq2_fig11", "cq2_fig12", "cq2_fig13"}


def test_no_time_is_no_work(tmp_path, capsys):
    words = ["--only", "cq2_fracture", "--minutes", "0", "--runs", str(tmp_path / "r"), "--out", str(tmp_path / "o")]
    assert command.main(words) == 75
    assert "not all is done: the same command goes on" in capsys.readouterr().out


def test_a_place_for_runs_that_cannot_be_is_told_by_its_option(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit):
        command.main(["--only", "cq2_fracture", "--runs", str(tmp_path / "file"), "--out", str(tmp_path / "o")])
    assert "choose another place with --runs" in capsys.readouterr().err


@pytest.fixture
def two_figures(tmp_path, monkeypatch):
    """The command's figures are two that count, to three each, and the words that run both."""
    toys = {}
    for name in ("one", "two"):
        toy = Toy(replace(COUNT, name=name, told=f"count {name}"))
        toy.id = name
        toys[name] = toy
    monkeypatch.setattr(command, "FIGURES", toys)
    monkeypatch.setattr(command, "write_page", lambda out: [])
    return toys, ["--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]


def test_a_figure_that_cannot_be_does_not_end_the_others(two_figures, capsys):
    toys, words = two_figures

    def broken(folder, deadline):
        raise WorkError("it does not count")

    toys["one"].works = (replace(toys["one"].works[0], measure=broken),)
    assert [command.main(words) for _ in range(3)] == [1, 1, 1]
    told = capsys.readouterr().out
    assert "error: one: it does not count" in told
    assert "quick: reproduced: they grow (yes)" in told


def test_a_fault_in_a_figure_does_not_end_the_others(two_figures, capsys):
    toys, words = two_figures
    toys["one"].table = lambda found, size: 1 / 0
    assert [command.main(words) for _ in range(4)][-1] == 1
    told = capsys.readouterr().out
    assert f"error: one: ZeroDivisionError: division by zero ({__file__}:" in told
    assert "quick: reproduced: they grow (yes)" in told


def test_what_another_engine_has_begun_is_left_alone(two_figures, tmp_path, capsys, monkeypatch):
    """It was started over, and that it was only told in the end."""
    _, words = two_figures

    def refused(work, runs, archive):
        if work.name == "one":
            raise WorkError("600 minutes of work by another engine")

    monkeypatch.setattr(rebuild, "restore", refused)
    assert [command.main(words) for _ in range(3)] == [1, 1, 1]
    assert "    left out: 600 minutes of work by another engine" in capsys.readouterr().out
    assert not (tmp_path / "runs" / "quick" / "one").exists()
    assert (tmp_path / "out" / "quick" / "two.png").exists()


def test_a_part_is_not_written_over_the_whole(two_figures, tmp_path, capsys):
    """A fresh clone has the figures that are committed, and none of their runs."""
    toys, words = two_figures
    assert [command.main(words) for _ in range(3)] == [75, 75, 0]
    files = sorted((tmp_path / "out" / "quick").glob("*.*"))
    before = [file.read_bytes() for file in files]
    shutil.rmtree(tmp_path / "runs")
    assert command.main(words) == 75
    assert "what is published is complete, and stays" in capsys.readouterr().out
    assert [file.read_bytes() for file in files] == before
    for toy in toys.values():  # a scene has changed: what was measured stays until all of it is measured again
        toy.works = tuple(replace(work, told=f"{work.told} again") for work in toy.works)
    assert command.main(words) == 75
    assert "it stays until this is" in capsys.readouterr().out
    assert [file.read_bytes() for file in files] == before
    assert list((tmp_path / "out" / "quick" / "unfinished").glob("*.tar.xz"))
    assert [command.main(words) for _ in range(2)] == [75, 0]
    record = json.loads((tmp_path / "out" / "quick" / "one.json").read_text())
    assert all(work["command"].endswith("again") for work in record["works"].values())


def test_a_small_part_is_not_written_over_a_larger_one(two_figures, tmp_path, capsys):
    """Twenty seconds of a paper-size figure were once published over an hour of it."""
    toys, words = two_figures
    assert command.main([*words, "--only", "one"]) == 75
    record = tmp_path / "out" / "quick" / "one.json"
    told = json.loads(record.read_text())
    told["works"]["one"]["minutes"] = 50.0
    record.write_text(json.dumps(told))
    for again in ("", " differently"):  # the same work from the start, and other work
        toys["one"].works = (replace(toys["one"].works[0], told=f"count one{again}"),)
        shutil.rmtree(tmp_path / "runs")
        assert command.main([*words, "--only", "one"]) == 75
        assert (
            "has 0 of 1 parts of the work done, 50 min: it stays until there is more, and here are 0 done"
            in capsys.readouterr().out
        )
        assert json.loads(record.read_text()) == told
    assert [command.main([*words, "--only", "one"]) for _ in range(2)] == [75, 0]  # the whole is more than any part
    assert json.loads(record.read_text())["done"] == [1, 1]


@pytest.mark.parametrize("file", ["runs/quick/one/clock.json", "out/quick/one.json", "out/quick/unfinished/one.tar.xz"])
def test_a_damaged_file_stops_only_its_figure(two_figures, tmp_path, capsys, file):
    _, words = two_figures
    assert command.main(words) == 75
    if "unfinished" in file:
        shutil.rmtree(tmp_path / "runs" / "quick" / "one")
    (tmp_path / file).write_bytes(b"")
    later = 0 if file.endswith("one.json") else 1  # what is published is done anew; what goes on is for its owner
    assert [command.main(words) for _ in range(3)] == [1, later, later]
    told = capsys.readouterr().out
    assert (tmp_path / file).name in told
    assert "quick: reproduced: they grow (yes)" in told
    assert (tmp_path / "out" / "quick" / "two.png").exists()


def test_what_is_published_and_damaged_is_told_on_the_page(tmp_path, capsys):
    shutil.copytree(PUBLISHED, tmp_path / "figures")
    (tmp_path / "figures" / "quick" / "cq2_fig5.json").write_text("<<<<<<< ours")
    (tmp_path / "figures" / "quick" / "cq2_fig6.png").unlink()
    (tmp_path / "figures" / "quick" / "cq2_fig7.csv").write_text("variant\n")
    assert command.main(["--page", "--out", str(tmp_path / "figures")]) == 1
    told, page = capsys.readouterr().out, (tmp_path / "figures" / "index.html").read_text()
    for name in ("cq2_fig5.json: not JSON", "cq2_fig6.png: is not there", "cq2_fig7.csv: not the numbers"):
        assert name in told
        assert name in page
    assert "3 damaged" in page
    words = ["--only", "cq2_fig7", "cq2_fracture", "--out", str(tmp_path / "figures")]
    assert command.main(["--judge", *words]) == 1  # the others are judged
    told = capsys.readouterr().out
    assert "cq2_fig7, quick: error: " in told
    assert "cq2_fracture, quick: reproduced" in told
    assert command.main(["--minutes", "0", "--unpublished", "--runs", str(tmp_path / "runs"), *words]) == 75
    assert "1 figures, size quick" in capsys.readouterr().out  # what cannot be read is not published
    record = tmp_path / "figures" / "quick" / "cq2_fig8.json"
    record.write_text("{}")
    assert command.main(["--page", "--out", str(tmp_path / "figures")]) == 1
    assert "cq2_fig8.json: lacks verdict" in (tmp_path / "figures" / "README.md").read_text()


def test_what_is_published_whole_may_be_left_out(two_figures, tmp_path, capsys):
    """A fresh clone goes on with what nobody has had yet; without the option it does everything once more."""
    toys, words = two_figures
    assert [command.main([*words, "--only", "one"]) for _ in range(3)] == [75, 75, 0]
    shutil.rmtree(tmp_path / "runs")
    assert [command.main([*words, "--unpublished"]) for _ in range(3)] == [75, 75, 0]
    assert "1 figures, size quick" in capsys.readouterr().out
    assert not (tmp_path / "runs" / "quick" / "one").exists()
    assert (tmp_path / "out" / "quick" / "two.png").exists()
    toys["one"].works = (replace(toys["one"].works[0], told="count one again"),)  # what is published is of other work
    assert command.main([*words, "--unpublished"]) == 75


def test_work_that_figures_share_is_counted_once(two_figures, capsys):
    toys, words = two_figures
    toys["two"].works = toys["one"].works
    command.main([*words, "--minutes", "0"])
    told = capsys.readouterr().out
    assert "2 figures, size quick: about 1 min of work left" in told


def test_committed_curves_of_ppo_are_of_the_work_that_they_are_taken_for(tmp_path, monkeypatch):
    finger = FIGURES["cq1_fig7_fixed"]
    monkeypatch.setattr("benchmarks.papers.families.learners.importlib.util.find_spec", lambda name: None)
    *_, ppo = finger.work(Size.QUICK)
    assert ppo.do(tmp_path / "a", 1.0, 1)
    assert ppo.remark(tmp_path / "a") == COMMITTED
    assert _remarks({"works": {"a": {"remark": ppo.remark(tmp_path / "a")}, "b": {"remark": ""}, "c": {}}}) == (
        f" (a: {COMMITTED})"
    )
    monkeypatch.setattr(type(finger), "squared", "")
    *_, other = finger.work(Size.QUICK)
    with pytest.raises(WorkError, match="PPO is left out: it needs stable_baselines3"):
        other.do(tmp_path / "b", 1.0, 1)


def test_the_gallery_is_of_what_is_committed(tmp_path):
    """`python -m benchmarks.papers --page` was run after what is committed was published."""
    shutil.copytree(PUBLISHED, tmp_path / "figures")
    write_page(tmp_path / "figures")
    assert (tmp_path / "figures" / "README.md").read_text() == (PUBLISHED / "README.md").read_text()


def test_the_page_stands_alone(tmp_path):
    write_page(tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert all(f'id="{figure.id}"' in page for figure in FIGURES.values())
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', page)
    assert "Not run yet: <code>python -m benchmarks.papers --only cq1_table2</code>" in page


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.skipif(shutil.which("chromium") is None, reason="Debian's package chromium is absent")
def test_the_page_in_a_browser(tmp_path, width):
    """Every picture is loaded, and nothing is wider than the window or than where it stands."""
    shutil.copytree(PUBLISHED, tmp_path / "figures")
    write_page(tmp_path / "figures")
    page = (tmp_path / "figures" / "index.html").read_text()
    script = """<script>addEventListener("load", () => {
      const shown = i => i.naturalWidth > 0 && i.getBoundingClientRect().width > 0;
      parent.document.title = JSON.stringify({width: innerWidth,
        broken: [...document.images].filter(i => !shown(i)).length,
        wide: document.documentElement.scrollWidth - innerWidth,
        cut: [...document.querySelectorAll(".scroll")].map(box => box.scrollWidth - box.clientWidth),
        sections: document.querySelectorAll("section").length}) })</script>"""
    (tmp_path / "page.html").write_text(page.replace(' loading="lazy"', "").replace("</body>", script + "</body>"))
    probe = tmp_path / "probe.html"  # a window of Chromium's own is no narrower than 500
    probe.write_text(f'<title></title><iframe src="page.html" style="border: 0; width: {width}px; height: 900px">')
    words = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    words += ["--allow-file-access-from-files", "--dump-dom", "--virtual-time-budget=20000"]
    words += [f"--user-data-dir={tmp_path / 'profile'}", probe.as_uri()]
    seen = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True).stdout
    (title,) = re.findall(r"<title>(\{.*?\})</title>", seen)
    told = json.loads(title)
    assert told["width"] == width
    assert told["broken"] == 0
    assert told["wide"] <= 0
    assert max(told["cut"]) <= 0
    assert told["sections"] == len(FIGURES)

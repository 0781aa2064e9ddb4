"""One page about several runs, about a sweep, or about another study; and the command `cqrun report`."""

from __future__ import annotations

import json
import shutil

import pytest
from pages import Read
from small_beam import BEAM
from tiny_beam import BEAM as TINY
from tiny_beam import E

from cqrun.cli import app as cli
from cqrun.jobs.simulate import run_simulate
from cqrun.report.several import MOST_RUNS, write_several
from cqrun.report.study import write_study_page


@pytest.fixture(scope="module")
def beams(tmp_path_factory):
    """Return two simulations of a beam that differ in their stiffness."""
    folder = tmp_path_factory.mktemp("beams")
    (folder / "beam.yaml").write_text(BEAM)
    path = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
    return [run_simulate(folder / "beam.yaml", [f"{path}={value}"], folder / "out", threads=1) for value in (3e4, 4e4)]


@pytest.fixture
def command(capsys):
    """Return a function that runs `cqrun` with some words, and returns exit code, output and errors."""

    def run(*words):
        with pytest.raises(SystemExit) as ended:
            cli.main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(ended.value.code or 0), out, err

    return run


def test_several_runs_are_side_by_side(beams, tmp_path):
    page = Read(write_several(beams, tmp_path / "page.html").read_text())
    assert page.problems == []
    assert "youngs_modulus 30000 40000" in page.text
    assert "duration" not in page.text.partition("What was found")[0].partition("What differs")[2]
    speeds = [json.loads((run / "result.json").read_text())["bodies"]["beam"]["fastest"] for run in beams]
    assert f"beam: top speed [m/s] {speeds[0]:.4g} {speeds[1]:.4g}" in page.text
    assert page.tags.count("details") > 2
    assert page.tags.count("img") >= 4
    assert "What the runs measure, a line for each run." in page.text
    assert page.text.count("@software") == 1


def test_runs_of_different_jobs_and_of_one_scene_can_be_compared(made_runs, tmp_path):
    page = Read(write_several(list(made_runs.values()), tmp_path / "page.html", pictures=False).read_text())
    assert page.problems == []
    assert "6 runs of fit, finger, design and 1 more" in page.text
    same = Read(write_several([made_runs["sysid"]] * 2, tmp_path / "same.html", pictures=False).read_text())
    assert "The scenes do not differ." in same.text


def test_only_the_first_of_many_runs_are_whole(beams, tmp_path):
    page = Read(write_several([beams[0]] * (MOST_RUNS + 2), tmp_path / "page.html", pictures=False).read_text())
    assert page.text.count("The report at the terminal") == MOST_RUNS
    assert f"whole reports of the first {MOST_RUNS} runs" in page.text


def test_the_command_writes_the_report_into_the_run(command, copied):
    run = copied("simulate")
    assert command("report", "-q", run) == (0, f"{run / 'report.html'}\n", "")
    assert (run / "report.html").is_file()
    code, out, _ = command("report", run, "-q", "-o", run.parent / "elsewhere" / "a.html")
    assert (code, out) == (0, f"{run.parent / 'elsewhere' / 'a.html'}\n")


def test_the_command_writes_one_page_for_several_runs(command, beams, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = command("report", "-q", *beams)
    assert code == 0
    assert out.startswith("results/report_beam_")
    assert (tmp_path / out.strip()).is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none"], "none: no run (it has no run.json)"),
        (["RUN", "-o", "page.pdf"], "-o page.pdf: a report is a web page: give a name that ends in .html"),
        (["sweep-none.json"], "sweep-none.json: unreadable (No such file or directory)"),
        (["RUN", "sweep-none.json"], "sweep-none.json: is a study of several runs: give it alone"),
        (["TWO"], "holds several studies: give one of"),
    ],
)
def test_what_cannot_be_reported_is_an_error_for_people(command, beams, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "two").mkdir()
    for name in ("sweep-1.json", "resolution-2.json"):
        (tmp_path / "two" / name).write_text("{}")
    places = {"RUN": beams[0], "TWO": tmp_path / "two"}
    code, out, err = command("report", "-q", *(places.get(word, word) for word in words))
    assert (code, out) == (2, "")
    assert message in err


def test_a_run_writes_its_report_when_it_ends(command, beam, tmp_path, pictures):
    code, out, err = command("simulate", beam, "--out", tmp_path / "out", "-q", "--threads", 1)
    assert code == 0, err
    (run,) = tmp_path.glob("out/beam/*")
    assert "see report.html, figures/bodies.png" in out
    page = Read((run / "report.html").read_text())
    assert page.tags.count("img") == 2
    again = (run / "report.html").read_bytes()
    assert command("report", "-q", run)[0] == 0
    assert (run / "report.html").read_bytes() == again
    assert command("simulate", beam, "--out", tmp_path / "out", "-q", "--threads", 1, "--fresh")[0] == 0


def test_without_pictures_the_report_has_none(command, beam, tmp_path):
    assert command("simulate", beam, "--out", tmp_path / "out", "-q", "--threads", 1)[0] == 0
    (run,) = tmp_path.glob("out/beam/*")
    assert "img" not in Read((run / "report.html").read_text()).tags
    assert not (run / "figures").exists()


def test_a_report_that_fails_does_not_make_the_run_fail(command, beam, tmp_path, monkeypatch):
    def broken(*_, **__):
        raise ValueError("no words\x1b[31m")

    monkeypatch.setattr("cqrun.report.page.write_page", broken)
    code, out, err = command("simulate", beam, "--out", tmp_path / "out", "-q", "--threads", 1)
    assert code == 0
    assert "done: 0.1 s simulated" in out
    assert "warning: no report: no words\\x1b[31m; `cqrun report " in err


@pytest.mark.slow
def test_a_sweep_has_a_page_with_its_table_its_picture_and_its_runs(command, tmp_path, pictures):
    scene = tmp_path / "tiny.yaml"
    scene.write_text(TINY)
    axes = ["-s", f"{E}=4e4,6e4", "-s", "seed=0,1"]
    code, out, err = command("sweep", scene, *axes, "--jobs", 2, "-q", "--out", tmp_path / "out", "--threads", 1)
    assert code == 0, err
    (study,) = tmp_path.glob("out/tiny/sweep-*.json")
    assert f"report: {study.with_suffix('.html')}\n" in out
    page = Read(study.with_suffix(".html").read_text())
    assert page.problems == []
    assert "run youngs_modulus seed status" in page.text
    assert page.tags.count("img") > 4
    links = [link for link in page.of("a", "href") if not link.startswith("#")]
    assert len(links) == 4
    assert all((study.parent / link).is_file() for link in links)
    before = study.with_suffix(".html").read_bytes()
    assert command("report", "-q", study.parent)[:2] == (0, f"{study.with_suffix('.html')}\n")
    assert study.with_suffix(".html").read_bytes() == before
    shutil.rmtree(study.parent / links[0].partition("/")[0])
    text = Read(write_study_page(study, pictures=False).read_text()).text
    assert "3 of 4 ended" in text

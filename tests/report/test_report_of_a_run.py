"""The report of a run: its numbers, warnings and words, for runs of every job; nothing in it is trusted."""

from __future__ import annotations

import json
import re
from importlib import resources

import numpy as np
import pytest
from pages import Read

from cqrun.errors import UsageError
from cqrun.jobs.rest import REST
from cqrun.report.blocks import Page, Section, Table, Text
from cqrun.report.html import LIMIT, html
from cqrun.report.page import write_report

EVIL = "<script>alert(1)</script> \"' & \u202e \x1b[31m é 漢 {{ 7*7 }}"


def read(path, **options):
    return Read(write_report(path, **options).read_text())


def change(run, file, **facts):
    """Change entries of a JSON file of a run."""
    path = run / file
    path.write_text(json.dumps(json.loads(path.read_text()) | facts))


def test_every_job_has_a_page_that_is_valid_and_stands_alone(each_run, tmp_path):
    file = write_report(each_run, tmp_path / "page.html")
    page = Read(file.read_text())
    assert page.problems == []
    assert file.stat().st_size < 5_000_000
    assert "script" not in page.tags
    fetched = [v for e, name, v in page.attributes if name in ("src", "srcset", "href", "data", "poster", "action")]
    assert all(value.startswith(("data:image/", "#")) for value in fetched)
    assert not {"link", "iframe", "object", "embed"} & set(page.tags)
    assert "url(" not in file.read_text()
    assert "default-src 'none'" in page.of("meta", "content")[-1]
    assert all(alt.strip() for alt in page.of("img", "alt"))
    assert len(page.of("img", "alt")) == page.tags.count("img")
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    assert {link.removeprefix("#") for link in page.of("a", "href")} <= set(ids)


def test_a_page_is_the_same_whenever_it_is_written(each_run, tmp_path):
    first, second = (write_report(each_run, tmp_path / f"{k}.html") for k in "ab")
    assert first.read_bytes() == second.read_bytes()


def test_an_identification_shows_values_intervals_errors_and_pictures(made_runs):
    page = read(made_runs["sysid"])
    result = json.loads((made_runs["sysid"] / "result.json").read_text())
    (path, young), *_ = result["unknowns"].items()
    assert path in page.text
    row = re.search(rf"Young's modulus ([0-9.]+) ([0-9.]+) to ([0-9.]+) kPa 30 10 to 100 {re.escape(path)}", page.text)
    shown = np.array([float(number) for number in row.groups()])
    assert np.allclose(shown, np.array([young["value"], *young["interval"]]) / 1e3, rtol=5e-3)
    rmse = result["recordings"]["synthetic"]["rmse_mm"]
    assert f"the fit displacement {rmse:.3f} mm" in page.text
    alts = page.of("img", "alt")
    assert any(alt.startswith("Recording synthetic: displacement, the data beside the model.") for alt in alts)
    assert any(alt.startswith("Film of the bodies (beam) from 0 to 0.1 s") for alt in alts)
    assert any(alt.startswith("The loss from ") for alt in alts)


def test_the_methods_have_the_numbers_of_the_run(made_runs):
    text = read(made_runs["sysid"], pictures=False).text
    assert (
        "a 2D grid with cells of 10 mm. The thinnest part of beam, 10 mm, has 1 cell and 2 particles across it." in text
    )
    assert "represented by 40 particles" in text
    assert "A motion lasted 0.1 s, in 10 control steps of 10 ms with 24 explicit substeps each (416.7 µs" in text
    assert "2 unknowns (Young's modulus, shear viscosity) were fitted to synthetic data with noise of 0.02 mm" in text
    assert "updated Lagrangian form" in text
    at_rest = read(made_runs["rest"], pictures=False).text
    assert "The total Lagrangian form was used" in at_rest
    assert "Volume changes were averaged" not in at_rest


def test_the_methods_say_what_volume_auto_came_to(made_runs, tmp_path):
    changes = ["bodies.beam.material.elastic.fixed_corotated.poissons_ratio=0.495", "time.substeps=auto"]
    run = REST.run(made_runs["rest"] / "scene.yaml", changes, tmp_path, threads=1)
    assert "Volume changes were averaged over the corners of cells" in read(run, pictures=False).text


def test_learned_runs_show_terms_constraints_and_unknowns(made_runs):
    result = json.loads((made_runs["codesign"] / "result.json").read_text())
    page = read(made_runs["codesign"], pictures=False)
    assert f"tip at most 0.03 {result['constraints']['tip']['start']:.5g}" in page.text
    (stiffness,) = (unknown["value"] for unknown in result["unknowns"].values())
    assert f"{min(stiffness):.4g} to {max(stiffness):.4g}, mean {np.mean(stiffness):.4g}" in page.text
    control = read(made_runs["control"], pictures=False).text
    stages = json.loads((made_runs["control"] / "result.json").read_text())
    assert f"Loss before {stages['start']['loss']:.4g}" in control
    assert "term before learned on unseen goals" in control


def test_simulations_equilibria_and_checks_show_their_numbers(made_runs):
    bodies = json.loads((made_runs["simulate"] / "result.json").read_text())["bodies"]
    assert f"Top speed {bodies['beam']['fastest']:.4g} m/s" in read(made_runs["simulate"], pictures=False).text
    rest = read(made_runs["rest"], pictures=False).text
    assert "Equilibria found 3 of 3" in rest
    assert "force.1" in rest
    assert "beam.tip.dy [m]" in rest
    assert "clamp.force_y [N/m]" in rest
    check = read(made_runs["gradcheck"], pictures=False).text
    assert re.search(r"Directions that agree (\d) of \1 ", check)


def test_command_machine_and_versions_are_those_of_the_run(copied):
    run = copied("simulate")
    change(run, "run.json", argv=["/somewhere/bin/cqrun", "simulate", "a scene.yaml", "-o", "x=1"], threads=2)
    record = json.loads((run / "run.json").read_text())
    text = read(run, pictures=False).text
    assert "cqrun simulate 'a scene.yaml' -o x=1" in text
    assert "/somewhere" not in text
    assert f"2 threads of {record['machine']['cores']} cores" in text
    assert f"Begun {record['began'][:10]} {record['began'][11:16]} UTC" in text
    assert record["engine"] in text
    assert f"numba {record['versions']['numba']}" in text
    assert "@software{cqrun," in text
    assert "{ChainQueen}" in text


def test_texts_of_strangers_are_shown_and_not_obeyed(copied):
    run = copied("simulate")
    change(run, "result.json", findings=[EVIL, "x" * 50_000], message=EVIL)
    change(run, "run.json", argv=["cqrun", EVIL], reason=EVIL, engine=EVIL, versions={"cqrun": EVIL, EVIL: EVIL},
           machine={"processor": EVIL, "cores": EVIL, "system": EVIL}, began=EVIL, git={"commit": EVIL})  # fmt: skip
    (run / "scene.original.yaml").write_text(f"</pre></details>{EVIL}")
    file = write_report(run, pictures=False)
    page = Read(file.read_text())
    assert page.problems == []
    assert "script" not in page.tags
    assert "<script>alert(1)</script>" in page.text
    assert "{{ 7*7 }}" in page.text
    assert "\x1b" not in file.read_text()
    assert "\u202e" not in file.read_text()


def test_old_and_damaged_records_have_a_page(copied):
    run = copied("simulate")
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({k: record[k] for k in ("status", "seconds", "job", "base")}))
    text = read(run, pictures=False).text
    assert "Machine" not in text.partition("Machine, time and versions")[2].partition("How to cite")[0]
    assert "started from Python" in text


def test_findings_and_missing_intervals_are_warnings(copied):
    run = copied("sysid")
    result = json.loads((run / "result.json").read_text())
    (path, first), *_ = result["unknowns"].items()
    result["unknowns"][path] = first | {"interval": None, "reason": "the data say nothing", "value": 1.0e5}
    result["findings"] = ["something `odd` happened"]
    (run / "result.json").write_text(json.dumps(result))
    page = read(run, pictures=False)
    warnings = page.text.partition("Warnings")[2]
    assert f"There is no interval for {path}: the data say nothing" in warnings
    assert "something odd happened" in warnings
    assert "at its bound 100" in page.text
    assert page.tags.count("code") > 1


def test_what_was_warned_about_before_a_run_is_among_its_warnings(copied):
    run = copied("simulate")
    change(run, "run.json", warnings=["beam.yaml:6:5: bodies.beam.shape: is 1 cell thick"])
    assert "bodies.beam.shape: is 1 cell thick" in read(run, pictures=False).text.partition("Warnings")[2]
    change(run, "run.json", warnings="damaged")
    assert "damaged" not in read(run, pictures=False).text


@pytest.mark.parametrize(("status", "words"), [("running", "has not ended"), ("failed", "The run failed. Too fast")])
def test_a_run_without_a_result_says_so(copied, status, words):
    run = copied("sysid")
    (run / "result.json").unlink()
    change(run, "run.json", status=status, reason="too fast")
    text = read(run, pictures=False).text
    assert words in text
    assert "The run has no result yet. So far it has done" in text


@pytest.mark.slow
def test_a_page_of_a_run_with_many_large_things_stays_small(copied):
    """Noise cannot be compressed, so these pictures have to become smaller, and some are left out."""
    from PIL import Image

    run, rng = copied("simulate"), np.random.default_rng(1)
    pictures = []
    for k in range(12):
        pictures.append(run / "figures" / f"tracks_{k}.png")
        pictures[-1].parent.mkdir(exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (700, 1100, 3), np.uint8)).save(pictures[-1])
    change(run, "result.json", findings=[f"finding {k} " + "y" * 5000 for k in range(500)])
    (run / "scene.original.yaml").write_text("# " + "z" * 3_000_000)
    assert sum(picture.stat().st_size for picture in pictures) > 2 * LIMIT
    file = write_report(run, drawn=pictures)
    assert file.stat().st_size < 5_000_000
    page = Read(file.read_text())
    assert page.tags.count("img") > 6
    assert "401 more are in result.json" in page.text  # of the 100 shown, one was a warning before the run


def test_a_picture_that_is_none_is_an_error_about_its_file(copied):
    run = copied("simulate")
    broken = run / "figures" / "bodies.png"
    broken.parent.mkdir(exist_ok=True)
    broken.write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    with pytest.raises(UsageError, match=r"bodies\.png: is not a picture that can be read"):
        write_report(run, drawn=[broken])


def test_a_damaged_trajectory_leaves_a_page_without_pictures_that_says_why(copied):
    run = copied("simulate")
    (run / "trajectory.h5").write_bytes(b"nothing")
    text = read(run).text
    assert "There are no pictures: " in text
    assert "trajectory.h5: not a cqrun trajectory, or damaged" in text


def test_the_resolution_of_the_grid_is_shown_with_the_study_of_it(copied):
    run = copied("simulate")
    text = read(run, pictures=False).text
    assert "beam 10 mm 1 2 beam: fewer than 3 cells across the thinnest part" in text
    assert "cqrun simulate SCENE --resolution" in text
    quantity = {"unit": "m", "values": [0.2, 0.21], "value": 0.22, "error": 0.01, "order": 2.0, "how": "assumed"}
    grids = [{"dx": dx, "run": f"elsewhere/{name}", "status": "done", "overrides": [], "thinnest": {}}
             for dx, name in ((0.01, run.name), (0.005, "0123456789ab"))]  # fmt: skip
    study = {
        "scene": "fit",
        "job": "simulate",
        "grids": grids,
        "quantities": {"beam.deflection": quantity},
        "notes": [],
    }
    (run.parent / "resolution-0123456789ab.json").write_text(json.dumps(study))
    text = read(run, pictures=False).text
    assert "beam.deflection m 0.2 0.21 0.22 0.01 2, assumed" in text
    assert "No other grid" not in text


def test_long_tables_end_and_empty_columns_are_left_out():
    table = Table(("name", "note", "value"), [(f"row {k}", "", str(k)) for k in range(1000)], rest="in a file")
    page = Read(html(Page("t", "", "done", "good", [Section("s", "S", [table, Text("a `b` <c>")])])))
    assert "row 199" in page.text
    assert "row 200" not in page.text
    assert "800 more rows are in a file" in page.text
    assert "note" not in page.text
    assert "a b <c>" in page.text
    assert table.styles[2] == "n"


def test_template_and_style_are_part_of_the_package():
    assert {"page.html.j2", "page.css"} <= {file.name for file in resources.files("cqrun.report").iterdir()}


def test_measured_quantities_have_a_table_and_a_picture(made_runs):
    page = read(made_runs["rest"])
    measured = json.loads((made_runs["rest"] / "result.json").read_text())["measured"]
    assert list(measured) == ["sag.x", "sag.y", "held.x", "held.y"]
    assert "Measured quantities" in page.text
    assert re.search(r"sag\.y m 0 -0\.0", page.text)
    alts = page.of("img", "alt")
    (shown,) = [alt for alt in alts if alt.startswith("The measured quantities")]
    assert re.fullmatch(r"The measured quantities \(sag.*held\) along the path of equilibria\.", shown)

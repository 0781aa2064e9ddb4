"""The option `--resolution` of the command line: with and without grids, before and after the scene."""

from __future__ import annotations

import pytest

from cqrun.cli.options import with_grids

SCENE = """\
cqrun: 1
world: {size: [0.2, 0.2], dx: 0.01, gravity: [0, -1], frame: reference}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.1], size: [0.12, 0.02]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.2]}}}}
time: {duration: 0.1, control_step: 0.01}
"""


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("rest a.yaml --resolution", "rest a.yaml --resolution=auto"),
        ("rest --resolution a.yaml", "rest --resolution=auto a.yaml"),
        ("rest a.yaml --resolution -q", "rest a.yaml --resolution=auto -q"),
        ("rest a.yaml --resolution 0.01,0.005", "rest a.yaml --resolution 0.01,0.005"),
        ("rest a.yaml --resolution .01,.005 -q", "rest a.yaml --resolution .01,.005 -q"),
        ("rest a.yaml --resolution=0.01,0.005", "rest a.yaml --resolution=0.01,0.005"),
    ],
)
def test_the_option_needs_no_value(words, meant):
    assert list(with_grids(words.split())) == meant.split()


def test_the_table_and_the_files(cqrun, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "beam.yaml").write_text(SCENE)
    code, out, err = cqrun("rest", "--resolution", "beam.yaml", "--threads", 1)
    assert code == 0, err
    lines = out.splitlines()
    assert lines[0] == "2 of 2 grids ended, with cells of 0.01, 0.0066667 m"
    assert any(line.startswith("quantity") and "extrapolated" in line and "error" in line for line in lines)
    assert any(line.startswith("beam.dy") for line in lines)
    (file,) = (tmp_path / "results" / "beam").glob("resolution-*.json")
    assert lines[-1] == f"resolution: {file.relative_to(tmp_path)}"
    assert "grid 2 of 2: cells of 0.0066667 m" in err
    assert cqrun("rest", "beam.yaml", "--resolution", "--quiet")[:2] == (0, out)


def test_wrong_grids_end_with_two(cqrun, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "beam.yaml").write_text(SCENE)
    code, _, err = cqrun("simulate", "beam.yaml", "--resolution", "0.01")
    assert (code, err.startswith("error: --resolution 0.01: names 1;")) == (2, True)
    code, _, err = cqrun("simulate", "beam.yaml", "--resolution", "--controller", "c.npz")
    assert (code, "remove --controller" in err) == (2, True)

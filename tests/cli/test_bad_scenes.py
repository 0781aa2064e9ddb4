"""Errors of bad scenes: exit code 2, the place, what is wrong; nothing is run."""

from __future__ import annotations

import pytest
from small_beam import BEAM, E_PATH, FIT

E_SHORT = "elastic: {fixed_corotated: {youngs_modulus: 3.0e4, poissons_ratio: 0.3}}"
BALL = "  ball:\n    shape: {ball: {center: [0.1, 0.065], radius: 0.02}}\n    particles_per_cell: 4\n"
BALL += "    material: {density: 1, " + E_SHORT + "}\nboundaries:"
NOWHERE = "{box: {corner: [0, 0], size: [0.01, 0.01]}}"
BOMB = "x: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
BOMB += "".join(f"x{k}: &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 10)}]\n" for k in range(8))

CASES = {
    "misspelt key": ("density: 1000", "densty: 1000", "densty: unknown key (did you mean 'density'?)"),
    "wrong range": ("dx: 0.01", "dx: -0.01", "fit.yaml:4:33: world.dx: must be greater than 0, is -0.01"),
    "nu of a half": ("poissons_ratio: 0.3", "poissons_ratio: 0.5", "poissons_ratio: must be less than 0.5, is 0.5"),
    "bounds that reach it": (
        "unknowns:",
        f"unknowns:\n  {E_PATH.replace('youngs_modulus', 'poissons_ratio')}: {{bounds: [0.2, 0.5]}}",
        "the bounds reach 0.5, but the value must be less than 0.5",
    ),
    "negative density": ("density: 1000", "density: -1", "density: must be greater than 0, is -1"),
    "nan": ("shear: 3", "shear: .nan", "viscosity.shear: must be a finite number, is nan"),
    "inf": ("density: 1000", "density: .inf", "density: must be a finite number, is inf"),
    "duplicate keys": ("density: 1000", "density: 1000\n      density: 900", "this key is here twice; the first"),
    "alias bomb": ("cqrun: 1", f"{BOMB}cqrun: 1", "aliases repeat more than 100000 parts; write them out"),
    "body outside the world": ("corner: [0.02, 0.06]", "corner: [0.1, 0.06]", "reaches x = 0.1975 m, above 0.16 m"),
    "overlapping bodies": ("boundaries:", BALL, "bodies.ball.shape: overlaps the body 'beam' in "),
    "zero particles in a region": (
        "time: {",
        f"loads: {{w: {{attached_mass: {{body: beam, mass: 1, region: {NOWHERE}}}}}}}\ntime: {{",
        "loads.w.attached_mass.region: holds no particle: 'beam' lies within",
    ),
    "too large a substep": ("substeps: 24", "substeps: 2", "of the largest stable one, "),
    "a duration between steps": ("duration: 0.1,", "duration: 0.105,", "0.105 s is not a multiple of the control step"),
    "odd power": ("viscosity: {shear: 3}", "incompressibility: {power: 3}", "incompressibility.power: 3 is odd"),
    "unknown without adjoint": ("unknowns:", "unknowns:\n  world.dx: {bounds: [1, 2]}", "no gradient reaches it"),
    "unknown named twice": ("unknowns:", f"unknowns:\n  {E_PATH}: {{bounds: [1, 2]}}", "this key is here twice"),
    "log scale with a bound of zero": ("bounds: [0.5, 20]", "bounds: [0, 20]", "needs bounds greater than 0"),
    "more memory than there is": ("title:", "memory: 900TiB\ntitle:", "fit.yaml:3:9: memory: "),
    "more grid than there is": ("size: [0.16", "size: [1.0e+8", "world: 2e+11 grid nodes need "),
}  # fmt: skip


@pytest.mark.parametrize("command", ["validate", "sysid"])
@pytest.mark.parametrize("name", CASES)
def test_a_bad_scene_is_refused_with_its_place(cqrun, tmp_path, monkeypatch, name, command):
    old, new, message = CASES[name]
    text = BEAM + FIT
    assert old in text
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fit.yaml").write_text(text.replace(old, new, 1))
    code, out, err = cqrun(command, "fit.yaml")
    assert code == 2
    assert out == ""
    assert message in err
    assert all(line.startswith("fit.yaml:") for line in err.splitlines()), err
    assert not (tmp_path / "results").exists()


def test_a_missing_scene(cqrun, tmp_path):
    code, out, err = cqrun("sysid", tmp_path / "none.yaml", "--out", tmp_path)
    assert (code, out) == (2, "")
    assert err == f"{tmp_path / 'none.yaml'}: the scene cannot be read: No such file or directory\n"


def test_all_problems_are_reported_at_once(cqrun, tmp_path):
    (tmp_path / "fit.yaml").write_text(BEAM.replace("dx: 0.01", "dx: 0").replace("shear: 3", "sheer: 3"))
    code, _, err = cqrun("validate", tmp_path / "fit.yaml", "-o", "time.duration=-1")
    assert code == 2
    assert "world.dx" in err
    assert "sheer" in err
    assert "-o time.duration=-1: time.duration: must be greater than 0, is -1" in err

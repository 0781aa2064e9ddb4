"""A small scene, and a fixture that returns the problems of a changed version of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cqrun.errors import SceneError
from cqrun.scene.load import load_scene

BEAM = """\
cqrun: 1
title: a beam
world: {size: [0.2, 0.1], dx: 0.005, gravity: [0, -9.81], frame: updated}
memory: 64MiB
bodies:
  beam:
    shape: {box: {corner: [0.05, 0.04], size: [0.1, 0.02]}}
    particles_per_cell: 4
    groups:
      tip: {box: {corner: [0.14, 0.04], size: [0.01, 0.02]}}
    material:
      density: 1070
      elastic:
        fixed_corotated:
          youngs_modulus: 2e5
          poissons_ratio: 0.45
      viscosity: {shear: 100}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.06, 0.1]}}}}
time:
  duration: 1.5
  control_step: 0.01
unknowns:
  bodies.beam.material.elastic.fixed_corotated.youngs_modulus:
    bounds: [1e5, 6e5]
    scale: log
  bodies.beam.material.viscosity.shear: {bounds: [1, 400], scale: log}
"""

Refused = Callable[..., list[str]]


@pytest.fixture
def beam() -> str:
    return BEAM


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Refused:
    """Return a function that replaces `old` by `new` in the beam, adds overrides, and returns the printed problems."""
    monkeypatch.chdir(tmp_path)

    def problems(old: str = "", new: str = "", *overrides: str) -> list[str]:
        assert old in BEAM
        Path("beam.yaml").write_text(BEAM.replace(old, new, 1) if old else BEAM)
        with pytest.raises(SceneError) as info:
            load_scene(Path("beam.yaml"), overrides)
        assert info.value.exit_code == 2
        return str(info.value).splitlines()

    return problems

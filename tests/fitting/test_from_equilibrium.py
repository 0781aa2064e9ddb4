"""A fit of a motion that starts at equilibrium: markers are measured from the rest shape, not from the first state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_beam import BEAM, E_PATH, MARKERS, Listener, result_of

from cqrun.build.matter import matter_of
from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.sysid import run_sysid
from cqrun.measurements.markers import observe_markers, over_body
from cqrun.scene.load import load_scene
from cqrun.store.formats.long_table import write_csv
from cqrun.store.synthetic import make_synthetic

SCENE = BEAM.replace("frame: updated", "frame: reference") + "start: equilibrium\n"
SCENE = SCENE.replace("duration: 0.1, control_step: 0.01, substeps: 24", "duration: 0.04, control_step: 0.01")
MARKED = ", ".join(f"{name}: {x}" for name, x in MARKERS.items())
DATA = f"""\
data:
  recordings:
    hung: {{file: hung.csv, start: 0.3, still: [0.0, 0.1], markers: {{{MARKED}}}}}
unknowns:
  {E_PATH}: {{bounds: [1.0e4, 1.0e5], scale: log}}
optimizer: {{least_squares: {{max_iterations: 8}}}}
"""


@pytest.fixture
def hung(tmp_path):
    """Return a scene whose recording shows the beam held straight at first, and later at rest under gravity."""
    built = build(load_scene(SCENE, [f"{E_PATH}=4e4"]))
    matter = matter_of(built, {})
    observer = observe_markers(matter, "beam", {name: np.array(x) for name, x in MARKERS.items()})
    model = replace(built.model, probe=over_body(observer.rows, "beam", matter))
    resting = observer.observe(make_rollout(model, built.assembly.inputs({})).run())[0][0]
    time = 0.002 * np.arange(200)
    seen = np.where((time < 0.2)[:, None, None], np.array(list(MARKERS.values())), resting)
    made = make_synthetic(time, tuple(MARKERS), seen, noise=1e-6, copies=1, rng=np.random.default_rng(0))
    write_csv(made[0], tmp_path / "hung.csv")
    scene = tmp_path / "hung.yaml"
    scene.write_text(SCENE + DATA)
    return scene


def test_the_sag_gives_the_stiffness(hung, tmp_path):
    result = result_of(run_sysid(hung, (), tmp_path / "out", reporter=Listener()))
    assert result["unknowns"][E_PATH]["value"] == pytest.approx(4e4, rel=1e-3)
    assert result["recordings"]["hung"]["rmse_mm"] < 0.003


def test_its_gradient_agrees_with_differences(hung, tmp_path):
    _, agrees = run_gradcheck(hung, (), tmp_path / "out", reporter=Listener())
    assert agrees

"""Runs of every job, for tests of reports."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_beam import BEAM, FIT
from small_finger import DESIGN, written

from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.rest import REST
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid

PULLED = """\
cqrun: 1
world: {size: [0.2, 0.2], dx: 0.01, gravity: [0, -9.81]}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.1], size: [0.12, 0.03]}}
    particles_per_cell: 4
    groups: {tip: {box: {corner: [0.13, 0.1], size: [0.01, 0.03]}}}
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries: {clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.2]}}}}}
loads:
  pull: {point_force: {body: beam, force: [0, 0], region: {box: {corner: [0.13, 0.1], size: [0.01, 0.03]}}}}
path: {loads.pull.point_force.force.1: {first: 0, last: -2, points: 3}}
measure: {sag: {displacement: {group: tip}}, held: {reaction: {boundary: clamp}}}
time: {duration: 0.1, control_step: 0.01}
"""

JOBS = ("sysid", "control", "codesign", "simulate", "rest", "gradcheck")


@pytest.fixture(scope="session")
def made_runs(tmp_path_factory) -> dict[str, Path]:
    """Return a run of each job."""
    folder = tmp_path_factory.mktemp("reported")
    fit, pulled, design = (folder / f"{name}.yaml" for name in ("fit", "pulled", "design"))
    fit.write_text(BEAM + FIT)
    pulled.write_text(PULLED)
    design.write_text(DESIGN)
    out, finger = folder / "out", written(folder)
    return {
        "sysid": run_sysid(fit, [], out, threads=1),
        "control": run_control(finger, [], out, threads=1),
        "codesign": run_codesign(design, ["constraints.tip.at_most=0.03"], out, threads=1),
        "simulate": run_simulate(fit, ["unknowns={}", "data=null"], out, threads=1),
        "rest": REST.run(pulled, [], out, threads=1),
        "gradcheck": run_gradcheck(fit, [], out, threads=1)[0],
    }


@pytest.fixture(params=JOBS)
def each_run(made_runs, request) -> Path:
    """Return a run of each job in turn."""
    return made_runs[request.param]


@pytest.fixture
def copied(made_runs, tmp_path):
    """Return a function that copies the run of a job, so that a test can change it."""

    def copy(job: str) -> Path:
        run = made_runs[job]
        return Path(shutil.copytree(run, tmp_path / run.parent.name / run.name))

    return copy
